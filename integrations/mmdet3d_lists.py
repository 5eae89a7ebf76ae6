"""Info lists of real scans for MMDetection3D 1.1 and later, made from the datasets' own folders.

They are the lists of its ``create_data.py``, reduced to the entries that training and validation
read, and made without its compiled operators. A list's file is JSON or, if its name ends with
``.pkl``, a pickle, as the stock configurations name it. ``split`` chooses the training or the
validation list.
"""

import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
from lidar_synth.integrations.detection import (
    difficulty,
    ground_plane,
    plane_in_camera,
)

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.files.disk import read_text, write_file
from lidar_synth.formats import KITTIObject, SemanticKITTI
from lidar_synth.formats.calibration import Calibration, in_view
from lidar_synth.formats.kitti_labels import boxes_to_camera
from lidar_synth.geometry import Boxes, Scan

CLASSES = (
    "Pedestrian",
    "Cyclist",
    "Car",
    "Van",
    "Truck",
    "Person_sitting",
    "Tram",
    "Misc",
)
"""The classes of ``KittiDataset``, in its order."""
OTHER = -1
"""The label of ``DontCare`` and of all other names, which the trainer leaves out of training. Its
evaluation calls them ``DontCare``, and excuses detections in their image boxes."""
DONT_CARE = {
    "bbox_label": OTHER,
    "bbox_3d": [-1000.0, -1000.0, -1000.0, -1.0, -1.0, -1.0, -10.0],
    "bbox_label_3d": OTHER,
    "depth": -1000.0,
    "num_lidar_pts": -1,
    "difficulty": -1,
    "truncated": -1.0,
    "occluded": -1,
    "alpha": -10.0,
    "score": 0.0,
    "index": -1,
}
"""An instance of a ``DontCare`` region, with the values of KITTI's label files for what it does not
have."""
ORDERS = ("uniform", "sequential")


def semantic_kitti_list(
    root: str | Path,
    out: str | Path,
    split: str = "train",
    share: float = 1.0,
    order: str = "uniform",
) -> Path:
    """Write the list of a SemanticKITTI folder; its paths are relative to ``root``.

    Args:
        root: the folder that holds ``sequences``.
        out: the list's file, ``.json`` or ``.pkl``.
        split: ``train`` or ``val``.
        share: of the scans of each sequence, above 0 and up to 1; at least one scan.
        order: which scans these are: ``uniform``, evenly spread, as in LaserMix (Kong et al., CVPR
            2023), or ``sequential``, the first ones, so that most places are never seen.

    Raises:
        ConfigError: on another name of ``out``, share or order.
        DataError, FileError: if the scans cannot be found, or the list cannot be written.
    """
    if not 0 < share <= 1:
        raise ConfigError(f"share {share}", "a number above 0 and up to 1, such as 0.1")
    if order not in ORDERS:
        raise ConfigError(f"order {order!r}", " or ".join(ORDERS))
    names = [name.split("/") for name in SemanticKITTI(root, split).ids]
    entries: list[dict[str, Any]] = []
    for sequence in dict.fromkeys(sequence for sequence, _ in names):
        frames = [frame for other, frame in names if other == sequence]
        count = max(1, round(share * len(frames)))
        base = f"sequences/{sequence}"
        chosen = (
            range(count)
            if order == "sequential"
            else np.arange(count) * len(frames) // count
        )
        for frame in (frames[i] for i in chosen):
            entry: dict[str, Any] = {
                "sample_idx": len(entries),
                "sample_id": f"{sequence}{frame}",
            }
            entry["lidar_points"] = {
                "lidar_path": f"{base}/velodyne/{frame}.bin",
                "num_pts_feats": 4,
            }
            entries.append(
                entry | {"pts_semantic_mask_path": f"{base}/labels/{frame}.label"}
            )
    return write_list(out, "SemanticKITTI", entries, {})


def kitti_list(
    root: str | Path,
    out: str | Path,
    split: str = "train",
    points: str = "velodyne_reduced",
) -> Path:
    """Write the list of a KITTI object folder; its paths are relative to
    ``<root>/training/<points>``.

    ``velodyne_reduced`` is written if it is missing. The ground plane is that of ``planes``, or
    fitted to the scan. ``DontCare`` regions are instances, as the trainer's evaluation needs them.

    Args:
        root: the folder that holds ``training`` and ``ImageSets``.
        out: the list's file, ``.json`` or ``.pkl``.
        split: ``train``, ``val`` or ``trainval``.
        points: folder of the points.

    Raises:
        ConfigError: on another name of ``out``.
        DataError, FileError: if a scan, its boxes or its calibration cannot be read, or the list
            not be written.
    """
    scans = KITTIObject(root, split)
    entries = []
    for number in range(len(scans)):
        scan = scans[number]
        camera = scans.calibration(number)
        if camera is None or camera.image_size is None or scan.boxes is None:
            raise DataError(
                f"{scan.id} of {root} has no calibration, image or boxes",
                "calib, image_2 and label_2",
            )
        part, frame = scan.id.split("/")
        seen = in_view(scan, camera)
        file = Path(root) / part / points / f"{frame}.bin"
        if points == "velodyne_reduced" and not file.is_file():
            write_file(
                file,
                np.column_stack([seen.points, seen.reflectance])
                .astype("<f4")
                .tobytes(),
            )
        planes = Path(root) / part / "planes" / f"{frame}.txt"
        plane = (
            read_plane(planes)
            if planes.is_file()
            else plane_in_camera(ground_plane(scan), camera)
        )
        entries.append(_entry(frame, scan, seen, camera) | {"plane": plane.tolist()})
    categories = {name: i for i, name in enumerate(CLASSES)} | {"DontCare": OTHER}
    return write_list(out, "KITTI", entries, categories)


def read_plane(path: Path) -> Any:
    """Read (4,) a, b, c, d from a plane's file: the fourth line, as in the published planes of
    KITTI."""
    lines = read_text(path).splitlines()
    if len(lines) < 4:
        raise DataError(
            f"{path} has {len(lines)} lines", "four, the plane in the last one"
        )
    return np.array(lines[3].split(), np.float64)


def write_plane(path: Path, plane: Any) -> None:
    """The inverse of ``read_plane``."""
    values = " ".join(f"{value:.12e}" for value in plane)
    write_file(path, f"# Matrix\nWIDTH 4\nHEIGHT 1\n{values}\n".encode())


def _entry(frame: str, scan: Scan, seen: Scan, camera: Calibration) -> dict[str, Any]:
    assert camera.image_size is not None and scan.boxes is not None
    cam2img = np.vstack([camera.projection, (0, 0, 0, 1)])
    lidar2cam = camera.camera_from_sensor
    image = {
        "img_path": f"{frame}.png",
        "height": camera.image_size[1],
        "width": camera.image_size[0],
    }
    image |= {
        k: v.tolist() for k, v in (("cam2img", cam2img), ("lidar2cam", lidar2cam))
    }
    image["lidar2img"] = (cam2img @ lidar2cam).tolist()
    return {
        "sample_idx": int(frame),
        "images": {"CAM2": image},
        "lidar_points": {"num_pts_feats": 4, "lidar_path": f"{frame}.bin"},
        "instances": _instances(scan.boxes, seen, camera),
    }


def _instances(boxes: Boxes, seen: Scan, camera: Calibration) -> list[dict[str, Any]]:
    floor, size, turn = boxes_to_camera(boxes.values, camera)
    counts = boxes.contain(seen.points).sum(1)
    levels = difficulty(boxes)
    instances = []
    for i, name in enumerate(boxes.names):
        label = CLASSES.index(name) if name in CLASSES else OTHER
        # Place, length, height, width, turn.
        box = [*floor[i], size[i, 2], size[i, 0], size[i, 1], turn[i]]
        facts = {
            "bbox": boxes.image_box[i],
            "bbox_label": label,
            "bbox_3d": box,
            "bbox_label_3d": label,
        }
        facts |= {
            "depth": floor[i, 2],
            "num_lidar_pts": counts[i],
            "difficulty": levels[i],
        }
        facts |= {
            "truncated": boxes.truncation[i],
            "occluded": boxes.occlusion[i],
            "alpha": boxes.alpha[i],
        }
        instances.append(
            {k: np.asarray(v).tolist() for k, v in facts.items()}
            | {"score": 0.0, "index": i, "group_id": i}
        )
    for rectangle in boxes.dont_care.tolist():
        instances.append(DONT_CARE | {"bbox": rectangle, "group_id": len(instances)})
    return instances


def write_list(
    out: str | Path,
    name: str,
    entries: list[dict[str, Any]],
    categories: dict[str, int],
) -> Path:
    """Write entries as a list of the trainer.

    Args:
        out: the list's file, ``.json`` or ``.pkl``.
        name: the dataset's.
        entries: of the scans.
        categories: number by class.

    Raises:
        ConfigError: on another name of ``out``, because the trainer chooses the reader by it.
        FileError: if it cannot be written.
    """
    writers = {".json": lambda data: json.dumps(data).encode(), ".pkl": pickle.dumps}
    if (suffix := Path(out).suffix) not in writers:
        raise ConfigError(f"a list in {out}", " or ".join(writers))
    meta = {"dataset": name, "categories": categories, "info_version": "1.1"}
    write_file(Path(out), writers[suffix]({"metainfo": meta, "data_list": entries}))
    return Path(out)
