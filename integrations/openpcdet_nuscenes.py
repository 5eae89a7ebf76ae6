"""OpenPCDet: nuScenes mixed with synthetic scans, ``DATASET: MixedNuScenes``."""

import warnings
from typing import Any

import numpy as np
from lidar_synth.integrations.detection import require_boxes
from lidar_synth.integrations.nuscenes import NAMES, as_nuscenes, five_values
from lidar_synth.integrations.openpcdet_mixture import MixedDetection
from pcdet.datasets.nuscenes.nuscenes_dataset import NuScenesDataset

from lidar_synth.errors import ConfigError
from lidar_synth.geometry import Scan

SRC = ["x", "y", "z", "intensity", "timestamp"]
"""The features that a sample has, in OpenPCDet's order."""


class MixedNuScenes(MixedDetection, NuScenesDataset):  # type: ignore[misc]
    """nuScenes mixed with synthetic scans at the ratio of its settings, see ``MixedDetection``.

    A synthetic scan becomes what OpenPCDet makes of the first key frame of a scene, which has no
    earlier sweeps: the scan itself in place of each, at time 0. The velocity of its boxes is
    unknown, which nuScenes writes as NaN.
    """

    def __init__(
        self, dataset_cfg: Any, class_names: Any, training: bool = True, **options: Any
    ) -> None:
        super().__init__(
            dataset_cfg=dataset_cfg,
            class_names=class_names,
            training=training,
            **options,
        )
        if not training:
            return
        features = list(dataset_cfg.POINT_FEATURE_ENCODING.src_feature_list)
        if self.use_camera or features != SRC:
            raise ConfigError(
                f"cameras {self.use_camera}, features {features} with MixedNuScenes",
                f"none, and {SRC}",
            )
        if dataset_cfg.MAX_SWEEPS > 1:
            warnings.warn(
                f"MAX_SWEEPS: {dataset_cfg.MAX_SWEEPS}, but a synthetic scan has one sweep, which "
                "is repeated: a "
                "network can tell it from a real one by its times. MAX_SWEEPS: 1 makes them alike.",
                stacklevel=2,
            )
        self._start(NAMES)

    def _synthetic(self, scan: Scan) -> Any:
        scan = as_nuscenes(scan)
        boxes = require_boxes(scan, self.known)
        points = five_values(scan)
        points[:, 4] = 0  # the time, in place of the ring
        sample = self.prepare_data(
            {
                "points": np.tile(points, (self.dataset_cfg.MAX_SWEEPS, 1)),
                "frame_id": f"synthetic/{scan.id}",
                "metadata": {"token": f"synthetic/{scan.id}"},
                "gt_boxes": np.pad(
                    boxes.values.astype(float),
                    ((0, 0), (0, 2)),
                    constant_values=np.nan,
                ),
                "gt_names": np.array(boxes.names, dtype=str),
            }
        )
        values = sample["gt_boxes"]
        if self.dataset_cfg.get("SET_NAN_VELOCITY_TO_ZEROS", False):
            values = np.nan_to_num(values)
        sample["gt_boxes"] = (
            values
            if self.dataset_cfg.PRED_VELOCITY
            else values[:, [0, 1, 2, 3, 4, 5, 6, -1]]
        )
        return sample

    def _trained_names(self, scan: Scan) -> set[str]:
        return {str(NAMES[name]) for name in super()._trained_names(scan)}
