"""Messages about objects without boxes, which would harm a detector; each is logged once per dataset."""

import logging

from torch.utils.data import get_worker_info

from lidar_synth.geometry.scan import Scan
from lidar_synth.labels.edit import measure

log = logging.getLogger(__name__)


class Notices:
    """Watches the scans of a mixture; only the main process and the first worker log."""

    def __init__(self) -> None:
        self._real_boxes = self._told = False

    def real(self, scan: Scan) -> None:
        """Note whether real scans have boxes."""
        self._real_boxes = self._real_boxes or scan.boxes is not None

    def synthetic(self, given: Scan, scan: Scan) -> None:
        """Report the unboxed objects of a synthetic scan, or that synthetic scans have no boxes where real ones do.

        Args:
            given: the scan before its label policy.
            scan: the scan with the labels and boxes of the policy.
        """
        if self._told or (scan.boxes is None and not self._real_boxes):
            return
        self._told = True
        worker = get_worker_info()
        if worker is not None and worker.id:
            return
        if scan.boxes is None:
            log.warning(
                "real scans have boxes, synthetic ones have none: a detector would learn that their objects are "
                "background. For a detector, use labels='mix' with objects, or labels='boxes' if the scans have boxes."
            )
        elif (found := measure([given])).objects:
            log.warning(
                "synthetic scan %r: %s, which unboxed='close' removes; only their number is reported with "
                "unboxed='keep'", given.id, found,
            )  # fmt: skip
