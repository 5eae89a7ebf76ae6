"""OpenPCDet: a dataset that mixes KITTI with synthetic scans, and a launcher that runs its own ``tools/train.py``::

    cd OpenPCDet/tools
    LIDAR_SYNTH_MIX=/data/mix.yaml python -m lidar_synth.integrations.openpcdet train.py \\
        --cfg_file cfgs/kitti_models/pointpillar.yaml --set DATA_CONFIG.DATASET MixedKitti

The settings (``mixture.OPTIONS``) may also be in the data configuration, under ``LIDAR_SYNTH``. OpenPCDet's files stay
unchanged, and its own code processes KITTI's samples.
"""

import runpy
import sys
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
from lidar_synth.integrations.detection import check_names, ground_plane, in_view, plane_in_camera
from lidar_synth.integrations.mixture import mix, points_of, read_settings
from lidar_synth.integrations.mmdet3d_lists import CLASSES

from lidar_synth.errors import ConfigError, DataError, LibraryError
from lidar_synth.formats.calibration import Calibration, homogeneous
from lidar_synth.geometry.scan import Scan

try:
    import pcdet.datasets
    from pcdet.datasets.kitti.kitti_dataset import KittiDataset
except ImportError as error:
    raise LibraryError(
        f"pcdet cannot be imported ({error})", "OpenPCDet 0.6, built in its checkout", "python setup.py develop"
    ) from error

if not pcdet.__version__.startswith("0.6."):
    raise LibraryError(f"OpenPCDet {pcdet.__version__}", "0.6", "git checkout v0.6.0, python setup.py develop")

NAME = "MixedKitti"


class MixedKitti(KittiDataset):  # type: ignore[misc]
    """KITTI mixed with synthetic scans at the ratio of its settings; evaluation uses only KITTI.

    OpenPCDet replaces a scan without boxes after augmentation by another random scan. To keep the ratio, a real scan is
    replaced by a real one here, and a synthetic one raises an error: ``labels: mix`` gives synthetic scans boxes.
    """

    def __init__(self, dataset_cfg: Any, class_names: Any, training: bool = True, **options: Any) -> None:
        super().__init__(dataset_cfg=dataset_cfg, class_names=class_names, training=training, **options)
        self._current: int | None = None  # the position whose sample is being made
        self.mixed = None
        if training:
            self.mixed = mix(
                len(self.kitti_infos), read_settings(dataset_cfg.get("LIDAR_SYNTH", None)), lambda scan, rng: scan
            )
            self._check_files()
            self._view = self._camera()
            self._check_boxes()

    def merge_all_iters_to_one_epoch(self, merge: bool = True, epochs: int | None = None) -> None:
        """Refuse to merge epochs of a mixture, which differ from one another.

        Raises:
            ConfigError: with ``merge`` for a mixture.
        """
        if merge and self.mixed is not None:
            raise ConfigError(f"merge_all_iters_to_one_epoch with {NAME}", "epochs one by one")
        super().merge_all_iters_to_one_epoch(merge, epochs)

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch, also for workers."""
        if self.mixed is not None:
            self.mixed.set_epoch(epoch)

    def domain(self, index: int) -> int:
        """0 if the sample at ``index`` is real in this epoch, 1 if it is synthetic."""
        return 0 if self.mixed is None else self.mixed.domain(index)

    def __len__(self) -> int:
        # While KITTI's own code works, it counts KITTI's scans.
        return super().__len__() if self.mixed is None or self._current is not None else len(self.mixed)

    def __getitem__(self, index: int) -> Any:
        if self.mixed is None:
            return super().__getitem__(index)
        if self._current is not None:
            return self._replacement(index)
        self._current = index
        try:
            sample = self.mixed[index]
            return self._synthetic(sample) if isinstance(sample, Scan) else super().__getitem__(int(sample))
        finally:
            self._current = None

    def _replacement(self, index: int) -> Any:
        """The sample with which ``prepare_data`` replaces a scan without boxes after augmentation."""
        assert self.mixed is not None and self._current is not None
        if not self.mixed.domain(self._current):
            return super().__getitem__(index % len(self.kitti_infos))
        scan = self.mixed[self._current]
        raise DataError(
            f"synthetic scan {scan.id!r} has no box of {list(self.class_names)} in range after augmentation",
            "at least one, because OpenPCDet would replace the scan by another one",
            "Use labels: mix with a bank of objects, and gt_sampling.",
        )

    def _synthetic(self, scan: Scan) -> Any:
        """Process a synthetic scan with the trainer's own augmentation and processing."""
        scan = in_view(scan, self._view[1]) if self.dataset_cfg.FOV_POINTS_ONLY else scan
        values = np.zeros((0, 7), np.float32) if scan.boxes is None else scan.boxes.values.copy()
        names = np.array([] if scan.boxes is None else scan.boxes.names, dtype=str)
        plane = plane_in_camera(ground_plane(scan), self._view[1])
        calib, image_shape = self._view[0], self._view[2]
        sample = self.prepare_data(
            {
                "frame_id": f"synthetic/{scan.id}",
                "calib": deepcopy(calib),
                "points": points_of(scan),
                "road_plane": plane,
                "gt_boxes": values,
                "gt_names": names,
            }
        )
        sample["image_shape"] = image_shape.copy()
        return sample

    def _check_files(self) -> None:
        """Check that every real scan has a calibration, and for GT sampling a plane, without which OpenPCDet fails."""
        frames = [info["point_cloud"]["lidar_idx"] for info in self.kitti_infos]
        needed = {"calib": ("KITTI's calibration of every scan", "")}
        if any(step.get("USE_ROAD_PLANE", False) for step in self._sampling()):
            hint = "lidar_synth.integrations.folders.write_planes(root) fits them."
            needed["planes"] = ("KITTI's planes, or USE_ROAD_PLANE: False", hint)
        for kind, (expected, hint) in needed.items():
            folder = self.root_split_path / kind
            missing = [f for f in frames if not (folder / f"{f}.txt").is_file()]
            if missing:
                raise ConfigError(f"{folder} without {len(missing)} scans ({missing[0]}, ...)", expected, hint)

    def _check_boxes(self) -> None:
        """Check by the first synthetic scan that there are boxes of known classes."""
        assert self.mixed is not None
        for position in np.flatnonzero(self.mixed.plan().domain)[:1]:
            scan = self.mixed[int(position)]
            check_names(scan, [*self.class_names, *CLASSES])
            if scan.boxes is None and not self._sampling():
                raise DataError(
                    f"synthetic scan {scan.id!r} has no boxes, and there is no gt_sampling",
                    "boxes, for a detector",
                    "labels: mix with a bank of objects, or gt_sampling, gives it some.",
                )

    def _sampling(self) -> list[Any]:
        """The steps of GT sampling that are in use."""
        steps = self.dataset_cfg.DATA_AUGMENTOR
        unused = steps.get("DISABLE_AUG_LIST", [])
        return [s for s in steps.AUG_CONFIG_LIST if s.NAME == "gt_sampling" and s.NAME not in unused]

    def _camera(self) -> tuple[Any, Calibration, Any]:
        """The camera of the first real scan, to which synthetic scans are cropped: OpenPCDet's object, our calibration,
        and the image shape."""
        items = set(self.dataset_cfg.get("GET_ITEM_LIST", ["points"]))
        if items - {"points"}:
            raise ConfigError(f"GET_ITEM_LIST {sorted(items)} with {NAME}", "['points']: there is no picture")
        info = self.kitti_infos[0]
        calib, shape = self.get_calib(info["point_cloud"]["lidar_idx"]), info["image"]["image_shape"]
        camera_from_sensor = homogeneous(calib.R0) @ homogeneous(calib.V2C)
        return calib, Calibration(calib.P2, camera_from_sensor, (int(shape[1]), int(shape[0]))), shape


def register() -> None:
    """Register ``DATASET: MixedKitti`` with OpenPCDet."""
    pcdet.datasets.__all__[NAME] = MixedKitti


def tell_epochs() -> None:
    """Make OpenPCDet's training loop set the epoch of its dataset; ``tools`` must be on the path."""
    from train_utils import train_utils as loop

    original = loop.train_one_epoch

    def with_epoch(model: Any, optimizer: Any, train_loader: Any, *args: Any, **options: Any) -> Any:
        if hasattr(train_loader.dataset, "set_epoch"):
            train_loader.dataset.set_epoch(options["cur_epoch"])
        return original(model, optimizer, train_loader, *args, **options)

    loop.train_one_epoch = with_epoch


def main() -> None:
    """Run one of OpenPCDet's scripts with the dataset registered: ``train.py`` or ``test.py`` and its arguments."""
    if len(sys.argv) < 2 or not Path(sys.argv[1]).is_file():
        raise SystemExit("usage, in OpenPCDet/tools: python -m lidar_synth.integrations.openpcdet train.py ARGUMENTS")
    sys.argv = sys.argv[1:]
    sys.path.insert(0, str(Path(sys.argv[0]).resolve().parent))
    register()
    tell_epochs()
    runpy.run_path(sys.argv[0], run_name="__main__")


if __name__ == "__main__":
    main()
