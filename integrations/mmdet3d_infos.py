"""Info lists for MMDetection3D with real and synthetic scans.

``write_infos`` writes into one folder::

    infos.json      the trainer's list: its own entries with absolute paths, then a slot for each
                    synthetic sample of an epoch, see ``mmdet3d_slots``
    mixture.json    the settings of the mixture

Real and synthetic scans must be in one list, because LaserMix, PolarMix and FrustumMix sample
partners from the dataset itself.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
from lidar_synth.integrations.detection import LOOKED_AT, require_boxes
from lidar_synth.integrations.mixture import refuse_unlabelled
from lidar_synth.integrations.mmdet3d_slots import (
    FORMAT,
    INFOS,
    LAYOUTS,
    MIXTURE,
    PREFIX,
    SlotFolder,
    open_folder,
)

from lidar_synth.errors import ConfigError, DataError, FileError
from lidar_synth.files.disk import read_text, write_file
from lidar_synth.files.parsing import parse_json

Entry = dict[str, Any]

PATHS = "synthetic", "root", "cache", "bank", "real", "as_sensor", "sensor", "like"
"""Settings that may be paths."""


def write_infos(
    out: str | Path,
    real: str | Path,
    settings: dict[str, Any],
    *,
    data_root: str | Path = "",
    points: str = "",
    sweeps: str = "",
    view: bool | None = None,
    layout: str | None = None,
    balance: bool = False,
) -> Path:
    """Write the mixed list beside the trainer's own.

    Args:
        out: output folder.
        real: the trainer's own list (``.pkl`` or ``.json``), as written by its ``create_data.py``.
        settings: settings of the mixture, see ``mixing.settings.OPTIONS``. With a schedule, or
            another ``epoch_size`` than ``"add"``, the list has as many slots as the epoch with most
            synthetic samples, and ``SynthSampler`` takes an epoch's entries from it.
        data_root: the folder to which the paths in ``real`` are relative.
        points: the folder of the points under ``data_root`` (the configuration's
            ``data_prefix['pts']``).
        sweeps: the folder of the sweeps between nuScenes' key frames (``data_prefix['sweeps']``).
        view: for detection, whether to crop synthetic scans to the view of the first real entry's
            CAM2, as in KITTI's ``velodyne_reduced``; by default if the entry has this camera.
        layout: ``"kitti"`` or ``"nuscenes"``, the form of points and boxes; by default nuScenes' if
            the list says that it is nuScenes'.
        balance: repeat real entries so that each class is in about as many, as ``CBGSDataset``
            does, which would change the ratio of a mixture.

    Returns:
        The mixed list, for ``ann_file``.

    Raises:
        ConfigError: on labels that make a loss NaN, a ratio that is no number, list or {epoch:
            ratio}, or objects among the settings; on ``view=True`` without a camera.
        DataError: on a list without entries, or of another format; for detection, on synthetic
            scans without boxes, or with boxes of names that the trainer does not know.
        FileError: if the scan of the first entry, or its labels, do not exist and the ratio is
            below 1.
    """
    out = Path(out).resolve()
    original = _read(real)
    entries = original["data_list"]
    detects = "instances" in entries[0]
    if not detects:
        refuse_unlabelled(settings, "MMDetection3D's segmentation")
    camera = _camera(entries[0], real, view) if detects else None
    for entry in entries:
        _make_absolute(entry, Path(data_root).resolve(), points, sweeps)
    # With synthetic scans alone no real scan is read, and it may have no labels.
    if settings.get("ratio") != 1:
        _check_files(entries[0])
    if balance:
        entries = _balanced(entries, int(settings.get("seed", 0)))
    facts: dict[str, Any] = {
        "format": FORMAT,
        "real": len(entries),
        "settings": _stored(settings),
        "layout": _layout(original, entries[0], layout, real),
        "view": None if view is False else camera,
    }
    folder = SlotFolder(out, facts)
    facts["plan"] = folder.mixed.plan(0).hash
    entries = entries + _slots(out, folder, entries, detects)
    write_file(out / MIXTURE, json.dumps(facts, indent=1).encode())
    listed = {"metainfo": original.get("metainfo", {}), "data_list": entries}
    write_file(out / INFOS, json.dumps(listed, default=_plain).encode())
    open_folder.cache_clear()  # this process may have opened an earlier list in this folder
    return out / INFOS


def _read(real: str | Path) -> Any:
    """The trainer's list, with at least one entry."""
    if Path(real).suffix == ".json":
        content = parse_json(
            read_text(Path(real)), str(real), "an info list of MMDetection3D"
        )
    else:
        # reads the trainer's own pickle, as the trainer does
        from mmengine.fileio import load

        content = load(str(real))
    if not isinstance(content, dict) or not content.get("data_list"):
        raise DataError(
            f"{real} has no 'data_list'", "an info list of MMDetection3D 1.1 or later"
        )
    return content


def _stored(settings: dict[str, Any]) -> dict[str, Any]:
    """The settings as a list keeps them: plain values, paths absolute."""
    if not isinstance(settings.get("ratio"), int | float | list | dict | None):
        raise ConfigError(
            f"ratio={settings['ratio']!r} for a list",
            "a number, a list or {epoch: ratio}",
        )
    stored: dict[str, Any] = _absolute(settings)
    try:
        json.dumps(stored)
    except TypeError as error:
        raise ConfigError(
            f"settings of a list that cannot be written: {error}",
            "plain values, as in YAML",
            "A policy by its name: labels={'paste': {'bank': FILE}}.",
        ) from error
    return stored


def _absolute(value: Any, name: Any = None) -> Any:
    """A setting, and those within it, with absolute paths; ``name`` is its key."""
    if isinstance(value, dict):
        return {key: _absolute(each, key) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_absolute(each, name) for each in value]
    is_path = isinstance(value, Path) or (
        isinstance(value, str)
        and str(name).lower() in PATHS
        and (name, value) != ("bank", "town")  # shipped with the package
        and (name == "cache" or Path(value).exists())
    )
    return str(Path(value).resolve()) if is_path else value


def _layout(
    content: dict[str, Any], entry: Entry, layout: str | None, real: str | Path
) -> str:
    """The layout of a list: ``layout``, or by default nuScenes' if the list says so, else
    KITTI's."""
    dataset = str(content.get("metainfo", {}).get("dataset", "")).lower()
    name = layout or ("nuscenes" if dataset == "nuscenes" else "kitti")
    if name not in LAYOUTS:
        raise ConfigError(f"layout={name!r}", f"one of {', '.join(LAYOUTS)}")
    features = entry["lidar_points"].get("num_pts_feats", LAYOUTS[name].features)
    if features != LAYOUTS[name].features:
        fits = ", ".join(
            f"{each!r} ({known.features})" for each, known in LAYOUTS.items()
        )
        raise ConfigError(
            f"{real}: points of {features} values for layout={name!r}",
            f"another layout: {fits}",
        )
    return name


def _slots(
    out: Path, folder: SlotFolder, entries: list[Entry], detects: bool
) -> list[Entry]:
    """The entries for synthetic scans; for detection, the first scans need boxes."""
    for slot in range(min(folder.slots, LOOKED_AT) if detects else 0):
        require_boxes(folder.scan(slot), folder.layout.classes)
    return [
        _slot(out, i, folder.layout.features, entries[i % len(entries)], detects)
        for i in range(folder.slots)
    ]


def _slot(out: Path, number: int, features: int, real: Entry, detects: bool) -> Entry:
    """An entry for a synthetic scan, with the keys of a real one."""
    base = f"{PREFIX}{out}/{number:06d}"
    name = f"synthetic/{number}"
    slot: Entry = {"sample_idx": name, "sample_id": name, "token": name}
    slot["lidar_points"] = {"lidar_path": f"{base}.bin", "num_pts_feats": features}
    if not detects:
        return slot | {"pts_semantic_mask_path": f"{base}.label"}
    if "CAM2" in real.get("images", {}):  # KittiDataset needs it to convert boxes
        slot["images"] = {
            "CAM2": {k: v for k, v in real["images"]["CAM2"].items() if k != "img_path"}
        }
    if "timestamp" in real:
        slot["timestamp"] = real["timestamp"]
    if "lidar_sweeps" in real:
        slot["lidar_sweeps"] = [
            _sweep(f"{base}.bin", sweep) for sweep in real["lidar_sweeps"]
        ]
    return slot | {"instances": []}


def _sweep(path: str, real: Entry) -> Entry:
    """A sweep of a synthetic scan: the scan itself at the time of a real sweep, as a standing
    sensor sees a street in which nothing moves. Number and times of sweeps are thus those of the
    real scans."""
    return {
        "timestamp": real["timestamp"],
        "lidar_points": {"lidar_path": path, "lidar2sensor": np.eye(4).tolist()},
    }


def _camera(entry: Entry, real: str | Path, view: bool | None) -> dict[str, Any] | None:
    """Camera 2 of a real entry as plain values, or None if it has none."""
    camera = entry.get("images", {}).get("CAM2", {})
    if {"lidar2cam", "cam2img", "height", "width"} <= set(camera):
        return {
            "projection": np.array(camera["cam2img"], float)[:3].tolist(),
            "camera_from_sensor": np.array(camera["lidar2cam"], float).tolist(),
            "image_size": [int(camera["width"]), int(camera["height"])],
        }
    if view:
        raise ConfigError(
            f"view=True, but the entries of {real} have images.CAM2 with {sorted(camera)}",
            "lidar2cam, cam2img, height and width, as in KITTI's lists",
            "Leave view out: synthetic scans then have the full turn.",
        )
    return None


def _make_absolute(entry: Entry, root: Path, points: str, sweeps: str) -> None:
    entry["lidar_points"]["lidar_path"] = str(
        root / points / entry["lidar_points"]["lidar_path"]
    )
    if "pts_semantic_mask_path" in entry:
        entry["pts_semantic_mask_path"] = str(root / entry["pts_semantic_mask_path"])
    for sweep in entry.get("lidar_sweeps", ()):  # the trainer takes the name only, too
        path = Path(sweep["lidar_points"]["lidar_path"])
        folder = points if "samples" in str(path) else sweeps
        sweep["lidar_points"]["lidar_path"] = str(root / folder / path.name)


def _check_files(entry: Entry) -> None:
    paths = [entry["lidar_points"]["lidar_path"], entry.get("pts_semantic_mask_path")]
    paths += [
        sweep["lidar_points"]["lidar_path"] for sweep in entry.get("lidar_sweeps", ())
    ]
    for path in filter(None, paths):
        if not Path(path).is_file():
            raise FileError(
                f"{path}, of the first entry, does not exist",
                "data_root, points and sweeps of write_infos that lead to the scans",
                "They are the configuration's data_root, data_prefix['pts'] and "
                "data_prefix['sweeps'].",
            )


def _balanced(entries: list[Entry], seed: int) -> list[Entry]:
    """Entries drawn so that each class is in about the same number of them (Zhu et al. 2019,
    arXiv:1908.09492).

    Entries of a rare class are drawn more often; classes without entries are left out.
    """
    by_class: dict[int, list[int]] = {}
    for number, entry in enumerate(entries):
        valid = [
            each for each in entry["instances"] if each.get("bbox_3d_isvalid", True)
        ]
        for label in {each["bbox_label_3d"] for each in valid} - {-1}:
            by_class.setdefault(int(label), []).append(number)
    if not by_class:
        raise DataError("a list without any box", "boxes, for balance=True")
    share = sum(map(len, by_class.values())) // len(by_class)
    rng = np.random.default_rng(seed)
    drawn = [rng.choice(by_class[label], max(share, 1)) for label in sorted(by_class)]
    return [
        json.loads(json.dumps(entries[i], default=_plain))
        for i in np.concatenate(drawn).tolist()
    ]


def _plain(value: Any) -> Any:
    return value.tolist()  # numpy's arrays and numbers, exactly
