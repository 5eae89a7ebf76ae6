"""Info lists for MMDetection3D with real and synthetic scans, and the scans behind synthetic entries.

``write_infos`` writes into one folder::

    infos.json      the trainer's list: its own entries with absolute paths, then a *slot* for each synthetic sample
                    of an epoch, whose files are lsynth://<folder>/<slot>.bin and .label
    mixture.json    the settings of the mixture
    epoch-<rank>    the current epoch, written by the hook and read by every worker process

Real and synthetic scans must be in one list, because LaserMix, PolarMix and FrustumMix sample partners from the
dataset itself. ``plan(seed, epoch)`` assigns a scan to each slot, a new one in each epoch.
"""

import json
from collections import OrderedDict
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from lidar_synth.integrations.detection import check_names, in_view
from lidar_synth.integrations.mixture import class_ids, id_table, mix, open_synthetic, points_of, refuse_unlabelled
from lidar_synth.integrations.mmdet3d_lists import CLASSES
from numpy.typing import NDArray

from lidar_synth.datasets.classes import SEMANTIC_KITTI
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.files.disk import read_text, write_file
from lidar_synth.formats.calibration import Calibration
from lidar_synth.formats.point_labels import encode_labels
from lidar_synth.geometry.scan import Boxes, Scan
from lidar_synth.mixing import Synthetic, make_synthetic
from lidar_synth.mixing.schedules import settled
from lidar_synth.mixing.state import place

PREFIX = "lsynth://"
MIXTURE, INFOS, EPOCH = "mixture.json", "infos.json", "epoch"
FORMAT = "lidar-synth-mmdet3d/1"
_CACHED = 4  # number of scans in the cache of a process: points, labels and boxes of a scan are read one after another


def write_infos(
    out: str | Path,
    real: str | Path,
    settings: dict[str, Any],
    *,
    data_root: str | Path = "",
    points: str = "",
    view: bool = True,
) -> Path:
    """Write the mixed list beside the trainer's own.

    Args:
        out: output folder.
        real: the trainer's own list (``.pkl`` or ``.json``), as written by its ``create_data.py``.
        settings: settings of the mixture, see ``mixture.OPTIONS``; one ratio for all epochs.
        data_root: the folder to which the paths in ``real`` are relative.
        points: the folder of the points under ``data_root`` (the configuration's ``data_prefix['pts']``).
        view: for detection, whether to crop synthetic scans to the view of the first real entry's camera, as in
            ``velodyne_reduced``.

    Returns:
        The mixed list, for ``ann_file``.

    Raises:
        ConfigError: on a mixture that a list cannot hold: a schedule, ``epoch_size``, labels that make a loss NaN.
        DataError: on a list without entries, or of another format; for detection, on entries without a camera or
            synthetic scans without boxes.
    """
    from mmengine.fileio import load  # reads the trainer's own pickle, as the trainer does

    out = Path(out).resolve()
    given = load(str(real))
    if not isinstance(given, dict) or not given.get("data_list"):
        raise DataError(f"{real} has no 'data_list'", "an info list of MMDetection3D 1.1 or later")
    entries = given["data_list"]
    detects = "instances" in entries[0]
    if not detects:
        refuse_unlabelled(settings, "MMDetection3D's segmentation")
    settings = {"synthetic": settings.get("synthetic"), "ratio": 0.25, "labels": "generated", "seed": 0} | settings
    if isinstance(settings["synthetic"], str | Path) and Path(settings["synthetic"]).exists():
        settings["synthetic"] = str(Path(settings["synthetic"]).resolve())
    camera = _camera(entries[0], real) if detects else None
    facts: dict[str, Any] = {"format": FORMAT, "real": len(entries), "settings": settings}
    facts["view"] = camera if view else None
    folder = Folder(out, facts)
    if detects and folder.slots:
        require_boxes(folder.scan(0))
        check_names(folder.scan(0), CLASSES)
    for entry in entries:
        _make_absolute(entry, Path(data_root).resolve(), points)
    entries += [_slot(out, i, camera) for i in range(folder.slots)]
    write_file(out / MIXTURE, json.dumps(facts | {"plan": folder.mixed.plan(0).hash}, indent=1).encode())
    listed = {"metainfo": given.get("metainfo", {}), "data_list": entries}
    write_file(out / INFOS, json.dumps(listed, default=_plain).encode())
    _write_epoch(out, 0)
    return out / INFOS


class Folder:
    """The slots of a mixed list.

    Args:
        path: the folder.
        facts: the content of its ``mixture.json``.

    Attributes:
        mixed: the mixture; its real samples are the numbers of the list's real entries.
        slots: number of synthetic samples in the first epoch; a later epoch may have one fewer, and then repeats one
            of its scans.
    """

    def __init__(self, path: Path, facts: dict[str, Any]) -> None:
        self.path, self.settings = path, facts["settings"]
        self.mixed = mix(facts["real"], self.settings, lambda scan, rng: scan)
        mixture = self.mixed.mixture
        if mixture.epoch_size != "add" or settled(mixture.ratio) != 0:
            raise ConfigError(
                f"ratio={self.settings['ratio']}, epoch_size={mixture.epoch_size!r} for MMDetection3D",
                "one ratio for all epochs, and epoch_size='add': a list is read once",
            )
        self.slots = len(self.mixed) - facts["real"]
        self._view = None if facts.get("view") is None else Calibration(**_arrays(facts["view"]))
        self._cached: OrderedDict[tuple[int, int], Scan] = OrderedDict()
        self._positions: tuple[int, NDArray[np.int64]] | None = None

    @classmethod
    def open(cls, path: Path) -> "Folder":
        """Open a folder of ``write_infos``.

        Raises:
            DataError: on another format, or if the synthetic scans, and thus the plan, have changed since.
        """
        facts = json.loads(read_text(path / MIXTURE))
        if facts.get("format") != FORMAT:
            raise DataError(f"{path / MIXTURE} has format {facts.get('format')!r}", FORMAT, "Write the list again.")
        folder = cls(path, facts)
        if folder.mixed.plan(0).hash != facts["plan"]:
            raise DataError(
                f"{path}: the synthetic scans {folder.settings['synthetic']} are not those of the list",
                "the bank or model for which the list was written",
                "Write the list again.",
            )
        return folder

    @property
    def epoch(self) -> int:
        """The current epoch of training."""
        file = self.path / f"{EPOCH}-{place(None, None)[0]}"
        return int(read_text(file)) if file.is_file() else 0

    @epoch.setter
    def epoch(self, epoch: int) -> None:
        _write_epoch(self.path, epoch)

    def scan(self, slot: int) -> Scan:
        """The scan of a slot in the current epoch, with its labels and boxes.

        Raises:
            DataError: on a slot that does not exist.
        """
        key = (self.epoch, slot)
        if key not in self._cached:
            scan = self.mixed.sample(*self._position(*key))
            self._cached[key] = scan if self._view is None else in_view(scan, self._view)
            if len(self._cached) > _CACHED:
                self._cached.popitem(last=False)
        return self._cached[key]

    def _position(self, epoch: int, slot: int) -> tuple[int, int]:
        """Epoch and position of a slot: in this epoch, or in the latest one with synthetic scans if it has none."""
        if not 0 <= slot < self.slots:
            raise DataError(f"slot {slot} of {self.path}", f"0 to {self.slots - 1}")
        while not self.mixed.plan(epoch).synthetics:
            epoch -= 1
        if self._positions is None or self._positions[0] != epoch:
            self._positions = (epoch, np.flatnonzero(self.mixed.plan(epoch).domain))
        return epoch, int(self._positions[1][slot % len(self._positions[1])])


open_folder = cache(Folder.open)
"""``Folder.open``, once per process and folder."""


@cache
def _opened(source: str) -> Synthetic:
    return make_synthetic(open_synthetic(source))


def read_url(url: str) -> bytes:
    """The bytes of ``lsynth://<source>/<number>.bin`` (float32 x, y, z, reflectance) or ``.label`` (SemanticKITTI's).

    Args:
        url: the URL; its source is the folder of a mixed list, a bank, a checkpoint or a folder of scans.

    Raises:
        DataError: on any other URL, or on labels of a scan without labels.
    """
    source, _, name = url.removeprefix(PREFIX).rpartition("/")
    number, _, kind = name.partition(".")
    if not (url.startswith(PREFIX) and source and number.isdigit() and kind in ("bin", "label")):
        raise DataError(f"{url!r}", f"{PREFIX}<folder or bank>/<number>.bin or .label")
    scan = scan_of(source, int(number))
    if kind == "bin":
        return points_of(scan).astype("<f4").tobytes()
    class_ids(scan, _TRAIN_IDS)
    return encode_labels(scan, SEMANTIC_KITTI).astype("<u4").tobytes()


_TRAIN_IDS = id_table(0, 255, np.uint8)


def scan_of(source: str, number: int) -> Scan:
    """The scan that a URL names."""
    if (Path(source) / MIXTURE).is_file():
        return open_folder(Path(source)).scan(number)
    return _opened(source)[number]


def require_boxes(scan: Scan) -> Boxes:
    """The boxes of a synthetic scan, for a detector; they may be zero in number.

    Raises:
        DataError: if ``scan.boxes`` is None.
    """
    if scan.boxes is None:
        raise DataError(
            f"synthetic scan {scan.id!r} has no boxes",
            "boxes, for a detector",
            "Write the list with labels='mix' and a bank of objects.",
        )
    return scan.boxes


def _slot(out: Path, number: int, camera: dict[str, Any] | None) -> dict[str, Any]:
    base = f"{PREFIX}{out}/{number:06d}"
    slot: dict[str, Any] = {
        "sample_idx": f"synthetic/{number}",
        "sample_id": f"synthetic/{number}",
        "lidar_points": {"lidar_path": f"{base}.bin", "num_pts_feats": 4},
    }
    if camera is None:
        return slot | {"pts_semantic_mask_path": f"{base}.label"}
    lidar2cam = camera["camera_from_sensor"]
    cam2img = np.vstack([camera["projection"], (0, 0, 0, 1)])
    images = {"CAM2": {"lidar2cam": lidar2cam, "cam2img": cam2img, "lidar2img": cam2img @ np.array(lidar2cam)}}
    return slot | {"images": images, "instances": []}


def _camera(entry: dict[str, Any], real: str | Path) -> dict[str, Any]:
    """Camera 2 of a real entry, plain values."""
    camera = entry.get("images", {}).get("CAM2", {})
    if not {"lidar2cam", "cam2img", "height", "width"} <= set(camera):
        raise DataError(f"{real}: entries without images.CAM2 {sorted(camera)}", "lidar2cam, cam2img, height, width")
    return {
        "projection": np.array(camera["cam2img"], float)[:3].tolist(),
        "camera_from_sensor": np.array(camera["lidar2cam"], float).tolist(),
        "image_size": [int(camera["width"]), int(camera["height"])],
    }


def _arrays(camera: dict[str, Any]) -> dict[str, Any]:
    return camera | {"image_size": tuple(camera["image_size"])}


def _make_absolute(entry: dict[str, Any], root: Path, points: str) -> None:
    entry["lidar_points"]["lidar_path"] = str(root / points / entry["lidar_points"]["lidar_path"])
    if "pts_semantic_mask_path" in entry:
        entry["pts_semantic_mask_path"] = str(root / entry["pts_semantic_mask_path"])


def _plain(value: Any) -> Any:
    return value.tolist()  # numpy's arrays and numbers, exactly


def _write_epoch(folder: Path, epoch: int) -> None:
    write_file(folder / f"{EPOCH}-{place(None, None)[0]}", str(epoch).encode())
