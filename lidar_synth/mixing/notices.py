"""Warnings about what would harm training without an error; each is logged once per dataset.

Objects without boxes, real scans without boxes or labels, reflectances or numbers of points that
tell real from synthetic, a bank used very often.
"""

import logging
from statistics import median
from zlib import crc32

import numpy as np
from torch.utils.data import get_worker_info

from lidar_synth.datasets.classes import IGNORE
from lidar_synth.errors import ConfigError
from lidar_synth.geometry import Scan
from lidar_synth.mixing.epochs import shared_integers
from lidar_synth.mixing.meaning import OTHER_SIZE
from lidar_synth.mixing.plan import MixingPlan

log = logging.getLogger(__name__)


FEW = 4
"""Number of scans of each kind whose points are counted before the numbers are compared."""

OFTEN = 4
"""Number of times that an epoch may use a synthetic scan without a warning."""


def report_repeats(plan: MixingPlan) -> None:
    """Log a warning for each synthetic source whose scans come very often in an epoch."""
    sources = zip(plan.mixture.synthetic, plan.counts[plan.reals :], strict=True)
    for source, count in sources:
        if source.length is not None and count > OFTEN * source.length:
            log.warning(
                "the %d scans of a synthetic source (%s) come %.0f times each in an epoch: a "
                "network learns them by heart. Bake more (lidar-synth bake OUT --count %d), use a "
                "generator, or a lower ratio.",
                source.length,
                source.identity[:40],
                count / source.length,
                count,
            )


class Notices:
    """Watches the scans of a mixture; only the main process and the first worker log.

    Args:
        images: whether batches are range images, in which the number of points has no meaning.
        boxes: whether scans are mixed for their boxes, so that real ones need no labels.
        boxed: whether synthetic scans are to have boxes.

    Attributes:
        segments: whether a segmenter is trained, which needs no boxes.
    """

    segments = False

    def __init__(self, images: bool, boxes: bool, boxed: bool) -> None:
        self._real_boxes = boxes  # whether real scans have boxes, or should
        # One bit for each logged message, shared by all processes, so that no epoch repeats it.
        self._logged = shared_integers(0)
        self._names: set[str] = set()  # of all boxes
        self._boxed = boxed
        # the id of a real scan without labels; "" if labels are not needed
        self._unlabelled: str | None = "" if boxes else None
        self._labelled = False  # whether a synthetic scan had labels
        self._images = images
        # points of real and of synthetic scans
        self._sizes: tuple[list[int], list[int]] = ([], [])

    def real(self, scan: Scan) -> None:
        """Report a reflectance above 1 or NaN, and boxes that are not known; note whether real
        scans have boxes and labels, and their numbers of points."""
        if np.isnan(scan.reflectance).any():
            self._warn("real scan %r has returns of reflectance NaN", scan.id)
        elif (scan.reflectance > 1).any():
            self._warn(
                "real scan %r has reflectances up to %g, synthetic ones up to 1: the scale tells "
                "them apart. Divide them where the Scan is made, intensities of 0 to 255 by 255.",
                scan.id,
                scan.reflectance.max(),
            )
        self._real_boxes |= scan.boxes is not None
        if self._boxed and self._real_boxes and scan.boxes is None:
            self._warn(
                "the boxes of real scan %r are not known (scan.boxes is None): a detector would "
                "learn that its objects are background. Leave such scans out: "
                "torch.utils.data.Subset(scans, [i for i, scan in enumerate(scans) if scan.boxes "
                "is not None]).",
                scan.id,
            )
        if self._unlabelled is None and (
            scan.label is None or not (scan.label != IGNORE).any()
        ):
            self._unlabelled = scan.id
        self._compare(0, scan)

    def _compare(self, kind: int, scan: Scan) -> None:
        """Compare the numbers of points of the first scans, labelled synthetic scans with
        unlabelled real ones, and the names of boxes."""
        if scan.boxes is not None:
            self._names |= set(scan.boxes.names)
            if len({name.lower() for name in self._names}) < len(self._names):
                self._warn(
                    "boxes have the names %s: a detector would take those that differ by capitals "
                    "for several classes, or miss some. Give real and synthetic ones the same.",
                    sorted(self._names),
                )
        if self._labelled and self._unlabelled is not None:
            self._warn(
                "real scan %r has no labels: all its points are 255 = ignore, and only synthetic "
                "scans teach classes. Open labelled scans (lidar-synth label kitti360 makes "
                "labels of KITTI-360), or leave it out.",
                self._unlabelled,
            )
        if self._images or len(self._sizes[kind]) >= FEW:
            return
        self._sizes[kind].append(len(scan))
        real, synthetic = self._sizes
        if len(real) == len(synthetic) == FEW:
            ours = median(synthetic)
            theirs = median(real)
            if max(ours, theirs) > OTHER_SIZE * min(ours, theirs):
                self._warn(
                    "a real scan has %d points, a synthetic one %d, on the same nominal grid: the "
                    "density tells them apart, or the view. Give load_generator columns= of that "
                    "density, as_sensor= a sensor of it, or use collate='range'. If real ones are "
                    "cropped to a camera's view (with_boxes()), crop synthetic ones too: "
                    "lidar_synth.formats.calibration.in_view(scan, real.calibration(0)).",
                    theirs,
                    ours,
                )

    def _warn(self, message: str, *values: object) -> None:
        """Log a warning, unless it has been logged."""
        if self._is_new(message):
            log.warning(message, *values)

    def _is_new(self, message: str) -> bool:
        """Whether this process may log, and the message has not been logged; it counts as logged
        afterwards."""
        worker = get_worker_info()
        if worker and worker.id:
            return False
        before = int(self._logged)
        self._logged |= 1 << crc32(message.encode()) % 63
        return int(self._logged) != before

    def lost_boxes(self, scan: Scan) -> None:
        """Report that the augmentation has removed the boxes of a scan.

        Raises:
            ConfigError: if synthetic scans are to have boxes.
        """
        if self._boxed:
            raise ConfigError(
                f"augment= that removes the boxes of scan {scan.id!r}",
                "one that keeps them, with labels='boxes' or 'paste'",
                "For a segmenter, {'paste': {'clear': 'same'}} gives scans without boxes none.",
            )
        if not self.segments:
            self._warn(
                "augment= removes the boxes of scans: a detector would learn that their objects "
                "are background"
            )

    def synthetic(self, original: Scan, scan: Scan) -> None:
        """Report the unboxed objects of a synthetic scan, or that synthetic scans have no boxes
        where real ones do.

        Args:
            original: the scan before its label policy.
            scan: the scan with the labels and boxes of the policy.
        """
        if scan.label is not None and self._unlabelled != "":
            self._labelled = self._labelled or bool((scan.label != IGNORE).any())
        self._compare(1, scan)
        if scan.boxes is None and self._real_boxes and not self.segments:
            self._warn(
                "real scans have boxes, synthetic ones have none: a detector would learn that "
                "their objects are background. For a detector, use labels='paste', or "
                "labels='boxes' if the scans have boxes."
            )
        if scan.boxes is None or not self._is_new("measured"):
            return
        from lidar_synth.labels.edit import measure  # loads networks

        unboxed = measure([original])
        if unboxed.objects:
            self._warn(
                "synthetic scan %r: %s, which unboxed='close' removes; only their number is "
                "reported with unboxed='keep'",
                original.id,
                unboxed,
            )
