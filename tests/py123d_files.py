"""Logs that py123d's own writer writes, of streets of the town; and those in ``golden/py123d``.

``python tests/py123d_files.py`` writes the latter anew; it needs py123d.
"""

import shutil
from pathlib import Path
from typing import Any

import numpy as np

from lidar_synth.datasets.classes import IGNORE
from lidar_synth.geometry.scan import Scan

GOLDEN = Path(__file__).parent / "golden" / "py123d"
DATASET = "nuscenes"
SPLITS = "nuscenes_train", "nuscenes_train", "nuscenes_val"
TO_NUSCENES = np.array(
    [17, 14, 21, 23, 15, 2, 14, 21, 24, 24, 26, 25, 28, 9, 30, 30, 27, 28, 28]
)
"""nuScenes' class of each label."""
START = 1_700_000_000_000_000
MOUNT = np.array([0.9, 0.0, 1.8, np.cos(-np.pi / 4), 0, 0, np.sin(-np.pi / 4)])
"""The sensor in the vehicle: x to the right, as nuScenes has it."""
EGO = np.array([700.0, -1500.0, 3.0, np.cos(1.0), 0, 0, np.sin(1.0)])
"""The vehicle in the world: turned by 2 radians."""


def town_scans(count: int = 3, points: int = 500) -> list[Scan]:
    """Some points of each of a few scans of the town."""
    from lidar_synth import Town

    rng = np.random.default_rng(0)
    scans = []
    for scan in Town(5, "hdl32e_nuscenes", scans=count):
        kept = np.sort(rng.choice(len(scan), points, replace=False))
        scans.append(scan[kept])
    return scans


def in_vehicle(points: np.ndarray) -> np.ndarray:
    """Points of the sensor in the frame of the vehicle: the sensor is not turned once x is
    ahead."""
    return (points + MOUNT[:3]).astype(np.float32)


def in_world(points: np.ndarray) -> np.ndarray:
    """Points of the vehicle in the world."""
    c, s = np.cos(2.0), np.sin(2.0)
    return points @ np.array([(c, s, 0), (-s, c, 0), (0, 0, 1)]) + EGO[:3]


def grey(scan: Scan) -> np.ndarray:
    """Reflectance as py123d stores it."""
    return np.round(scan.reflectance * 255).astype(np.uint8)


def write_logs(
    root: Path, scans: list[Scan], codec: str = "laz", **changes: Any
) -> None:
    """Write each scan as a log of its own with py123d's writer.

    ``changes``: ``lidar`` = False leaves out the clouds, ``path`` stores a path instead.
    """
    from py123d.api.scene.arrow.arrow_log_writer import ArrowLogWriter
    from py123d.api.scene.arrow.utils.log_writer_config import LogWriterConfig
    from py123d.datatypes import LogMetadata
    from py123d.datatypes.detections import box_detections as boxes
    from py123d.datatypes.detections.box_detections_metadata import (
        BoxDetectionsSE3Metadata,
    )
    from py123d.datatypes.sensors import lidar as sensors
    from py123d.datatypes.time import Timestamp
    from py123d.datatypes.vehicle_state.ego_state import EgoStateSE3
    from py123d.datatypes.vehicle_state.ego_state_metadata import EgoStateSE3Metadata
    from py123d.geometry import BoundingBoxSE3, PoseSE3
    from py123d.parser.base_dataset_parser import ModalitiesSync, ParsedLidar
    from py123d.parser.lidar_segmentation_registry import NuScenesLidarSegmentationLabel
    from py123d.parser.registry import NuScenesBoxDetectionLabel as Names

    path = changes.get("path")
    config = LogWriterConfig(
        lidar_store_option="path" if path else "binary",
        lidar_codec=codec,  # type: ignore[arg-type]
        write_route=False,
    )
    top = sensors.LidarMetadata(
        "LIDAR_TOP",
        sensors.LidarID.LIDAR_TOP,
        PoseSE3.from_array(MOUNT),
        NuScenesLidarSegmentationLabel,
    )
    front = sensors.LidarMetadata("FRONT", sensors.LidarID.LIDAR_FRONT)
    merged = sensors.LidarMergedMetadata({m.lidar_id: m for m in (top, front)})
    middle = PoseSE3.identity()
    vehicle = EgoStateSE3Metadata("car", 1.8, 4.5, 1.6, 2.7, middle, middle)
    names = {"Car": Names.VEHICLE_CAR, "Truck": Names.VEHICLE_TRUCK}
    for number, scan in enumerate(scans):
        writer = ArrowLogWriter(config, root, root, ipc_compression="zstd")
        writer.reset(LogMetadata(DATASET, SPLITS[number], f"log{number}", None))
        now = Timestamp.from_us(START + number * 100_000)
        assert scan.boxes is not None and scan.label is not None
        found = []
        for name, box in zip(
            scan.boxes.names, scan.boxes.values.astype(float), strict=True
        ):
            half = (box[6] + 2.0) / 2
            place = in_world(in_vehicle(box[None, :3]))[0]
            pose = PoseSE3.from_array(
                np.array([*place, np.cos(half), 0, 0, np.sin(half)])
            )
            label = names.get(name, Names.HUMAN_PEDESTRIAN_ADULT)
            about = boxes.BoxDetectionAttributes(label, f"track{len(found)}", 7)
            found.append(boxes.BoxDetectionSE3(about, BoundingBoxSE3(pose, *box[3:6])))
        modalities: list[Any] = [
            EgoStateSE3.from_imu(PoseSE3.from_array(EGO), vehicle, now),
            boxes.BoxDetectionsSE3(found, now, BoxDetectionsSE3Metadata(Names)),
        ]
        count = len(scan)
        ring = 31 - np.asarray(scan.ring)
        known = scan.label != IGNORE
        classes = TO_NUSCENES[np.where(known, scan.label, 0)] * known
        features = {
            "ids": np.full(count, 2, np.uint8),
            "intensity": grey(scan),
            "channel": ring.astype(np.uint8),
            "timestamps": now.time_us + np.arange(count, dtype=np.int64) * 10,
            "semantic": classes.astype(np.uint8),
        }
        # Five points of the sensor in front, which are not the scan's.
        other = {n: v[:5] + np.uint8(n == "ids") for n, v in features.items()}
        features = {n: np.concatenate([other[n], v]) for n, v in features.items()}
        cloud = in_vehicle(np.concatenate([scan.points[:5] + 1, scan.points]))
        if path:
            modalities.append(ParsedLidar(merged, now, now, root, path))
        elif changes.get("lidar", True):
            modalities.append(sensors.Lidar(now, now, merged, cloud, features))
        writer.write_sync(ModalitiesSync(now, modalities))
        writer.close()


def copy_logs(root: Path) -> list[Path]:
    """Three logs of a scan each; the files of their clouds."""
    shutil.copytree(GOLDEN, root, dirs_exist_ok=True)
    return sorted(root.rglob("lidar.*.arrow"))


def split_sensors(root: Path) -> None:
    """Gives each sensor of the logs a file of its own, with all points of the merged one."""
    import msgpack
    import pyarrow as pa

    for sync in root.rglob("sync.arrow"):
        merged = sync.parent / "lidar.lidar_merged.arrow"
        points = pa.ipc.open_file(merged.read_bytes()).read_all()
        facts = msgpack.unpackb(
            points.schema.metadata[b"metadata"], strict_map_key=False
        )
        rows = pa.ipc.open_file(sync.read_bytes()).read_all()
        names = rows.column_names
        place = names.index("lidar.lidar_merged")
        for number, mount in facts.items():
            name = f"lidar.sensor_{number}"
            packed = {b"metadata": msgpack.packb({"lidar_id": int(number), **mount})}
            _write(
                sync.parent / f"{name}.arrow", points.replace_schema_metadata(packed)
            )
            rows = rows.append_column(name, rows.column(place))
        _write(sync, rows.remove_column(place))
        merged.unlink()


def _write(path: Path, table: Any) -> None:
    import pyarrow as pa

    with pa.OSFile(str(path), "wb") as file, pa.ipc.new_file(file, table.schema) as out:
        out.write_table(table)


if __name__ == "__main__":
    shutil.rmtree(GOLDEN, ignore_errors=True)
    write_logs(GOLDEN, town_scans())
