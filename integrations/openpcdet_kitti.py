"""OpenPCDet: KITTI mixed with synthetic scans, ``DATASET: MixedKitti``."""

from copy import deepcopy
from typing import Any

import numpy as np
from lidar_synth.integrations.detection import (
    ground_plane,
    plane_in_camera,
    require_boxes,
)
from lidar_synth.integrations.mixture import points_of
from lidar_synth.integrations.mmdet3d_lists import CLASSES
from lidar_synth.integrations.openpcdet_mixture import MixedDetection
from pcdet.datasets.kitti.kitti_dataset import KittiDataset

from lidar_synth.errors import ConfigError
from lidar_synth.formats.calibration import Calibration, homogeneous, in_view
from lidar_synth.geometry import Scan


class MixedKitti(MixedDetection, KittiDataset):  # type: ignore[misc]
    """KITTI mixed with synthetic scans at the ratio of its settings, see ``MixedDetection``.

    A synthetic scan gets the calibration of the first real scan and a fitted ground plane.
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
        if training:
            self._check_files()
            self._view = self._camera()
            self._start(CLASSES)

    def _synthetic(self, scan: Scan) -> Any:
        scan = (
            in_view(scan, self._view[1]) if self.dataset_cfg.FOV_POINTS_ONLY else scan
        )
        boxes = require_boxes(scan, self.known)
        plane = plane_in_camera(ground_plane(scan), self._view[1])
        calib = self._view[0]
        image_shape = self._view[2]
        sample = self.prepare_data(
            {
                "frame_id": f"synthetic/{scan.id}",
                "calib": deepcopy(calib),
                "points": points_of(scan),
                "road_plane": plane,
                "gt_boxes": boxes.values.copy(),
                "gt_names": np.array(boxes.names, dtype=str),
            }
        )
        sample["image_shape"] = image_shape.copy()
        return sample

    def _check_files(self) -> None:
        """Check that every real scan has a calibration, and for GT sampling a plane, without which
        OpenPCDet fails."""
        frames = [info["point_cloud"]["lidar_idx"] for info in self.kitti_infos]
        needed = {"calib": ("KITTI's calibration of every scan", "")}
        if any(step.get("USE_ROAD_PLANE", False) for step in self._sampling()):
            hint = "lidar_synth.integrations.folders.write_planes(root) fits them."
            needed["planes"] = ("KITTI's planes, or USE_ROAD_PLANE: False", hint)
        for kind, (expected, hint) in needed.items():
            folder = self.root_split_path / kind
            missing = [f for f in frames if not (folder / f"{f}.txt").is_file()]
            if missing:
                raise ConfigError(
                    f"{folder} without {len(missing)} scans ({missing[0]}, ...)",
                    expected,
                    hint,
                )

    def _camera(self) -> tuple[Any, Calibration, Any]:
        """The camera of the first real scan, to which synthetic scans are cropped: OpenPCDet's
        object, our calibration, and the image shape."""
        items = set(self.dataset_cfg.get("GET_ITEM_LIST", ["points"]))
        if items - {"points"}:
            raise ConfigError(
                f"GET_ITEM_LIST {sorted(items)} with MixedKitti",
                "['points']: there is no picture",
            )
        info = self.kitti_infos[0]
        calib = self.get_calib(info["point_cloud"]["lidar_idx"])
        shape = info["image"]["image_shape"]
        camera_from_sensor = homogeneous(calib.R0) @ homogeneous(calib.V2C)
        return (
            calib,
            Calibration(calib.P2, camera_from_sensor, (int(shape[1]), int(shape[0]))),
            shape,
        )
