"""Pickled tables as pandas 0.25 writes them, without pandas, and small datasets in PandaSet's
layout."""

import gzip
import io
import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
from conftest import random_scan

from lidar_synth.files.pickles import Call, Name
from lidar_synth.formats.pandaset_tracks import MOUNTS
from lidar_synth.geometry.motion import interpolate_poses
from lidar_synth.geometry.scan import Scan
from lidar_synth.geometry.sensor import load_sensor


class _Pickler(pickle._Pickler):  # type: ignore[name-defined,misc]
    """Writes ``Name`` and ``Call`` as what they stand for; the inverse of ``parse_pickle``."""

    dispatch = pickle._Pickler.dispatch.copy()  # type: ignore[attr-defined]

    def save_name(self, name: Name) -> None:
        module, _, attribute = name.text.rpartition(".")
        self.write(pickle.GLOBAL + f"{module}\n{attribute}\n".encode())
        self.memoize(name)

    def save_call(self, call: Call) -> None:
        self.save(Name(call.name))
        self.save(call.args)
        self.write(pickle.REDUCE if call.args else pickle.NEWOBJ)
        self.memoize(call)
        if call.state is not None:
            self.save(call.state)
            self.write(pickle.BUILD)

    dispatch[Name] = save_name
    dispatch[Call] = save_call


def dump(tree: Any, protocol: int = 3) -> bytes:
    """The pickle that ``parse_pickle`` reads as ``tree``."""
    file = io.BytesIO()
    _Pickler(file, protocol).dump(tree)
    return file.getvalue()


INDEXES = "pandas.core.indexes"


def array(
    values: Any, *, dtype: str | None = None, shape: tuple[int, ...] | None = None
) -> Call:
    """An array as numpy pickles it; ``dtype`` and ``shape`` may say something else than it
    holds."""
    values = np.asarray(values)
    kind = dtype or ("O8" if values.dtype == object else values.dtype.str[1:])
    state = (
        3,
        "|" if kind[0] in "Ob" else "<",
        None,
        None,
        None,
        -1,
        -1,
        63 if kind[0] == "O" else 0,
    )
    data = values.ravel().tolist() if values.dtype == object else values.tobytes()
    made = (
        1,
        values.shape if shape is None else shape,
        Call("numpy.dtype", (kind, 0, 1), state),
        False,
        data,
    )
    return Call(
        "numpy.core.multiarray._reconstruct", (Name("numpy.ndarray"), (0,), b"b"), made
    )


def table(columns: dict[str, Any]) -> Call:
    """A table as pandas 0.25 pickles it: columns of one type in one block."""
    names = list(columns)
    arrays = [np.asarray(values) for values in columns.values()]
    arrays = [
        values.astype(object) if values.dtype.kind == "U" else values
        for values in arrays
    ]
    blocks = []
    for kind in sorted({values.dtype.str for values in arrays}):
        places = [i for i, values in enumerate(arrays) if values.dtype.str == kind]
        blocks.append(
            {
                "values": array(np.stack([arrays[i] for i in places])),
                "mgr_locs": array(np.array(places)),
            }
        )
    labels = {"data": array(np.array(names, object)), "name": None}
    index = Call(f"{INDEXES}.base._new_Index", (Name(f"{INDEXES}.base.Index"), labels))
    length = {"start": 0, "stop": len(arrays[0]), "step": 1}
    rows = Call(
        f"{INDEXES}.base._new_Index", (Name(f"{INDEXES}.range.RangeIndex"), length)
    )
    axes = [index, rows]
    state = (
        axes,
        [block["values"] for block in blocks],
        axes,
        {"0.14.1": {"axes": axes, "blocks": blocks}},
    )
    manager = Call("pandas.core.internals.managers.BlockManager", (), state)
    return Call(
        "pandas.core.frame.DataFrame",
        (),
        {"_data": manager, "_typ": "dataframe", "_metadata": []},
    )


def write_table(path: Path, columns: dict[str, Any]) -> None:
    """A compressed table; the same bytes at any time."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(gzip.compress(dump(table(columns)), mtime=0))


def drive(count: int) -> tuple[np.ndarray, np.ndarray]:
    """(P,) times and (P, 4, 4) poses of a vehicle that turns, ten a second."""
    times = 1.5e9 + 0.1 * np.arange(count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    for i, pose in enumerate(poses):
        yaw = 0.4 + 0.05 * i
        pose[:2, :2] = [(np.cos(yaw), -np.sin(yaw)), (np.sin(yaw), np.cos(yaw))]
        pose[:3, 3] = 1.5 * i, 0.3 * i * i, 0.02 * i
    return times, poses


def quaternion(pose: np.ndarray) -> dict[str, float]:
    """The heading of a pose that turns about z."""
    yaw = np.arctan2(pose[1, 0], pose[0, 0])
    return {
        "w": float(np.cos(yaw / 2)),
        "x": 0.0,
        "y": 0.0,
        "z": float(np.sin(yaw / 2)),
    }


def write_track(folder: Path, times: np.ndarray, poses: np.ndarray) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    headings = [
        {
            "position": dict(zip("xyz", pose[:3, 3].tolist(), strict=True)),
            "heading": quaternion(pose),
        }
        for pose in poses
    ]
    (folder / "poses.json").write_text(json.dumps(headings))
    (folder / "timestamps.json").write_text(json.dumps(times.tolist()))


def measured(
    seed: int, sensor: str = "pandar64", count: int = 400
) -> tuple[Scan, np.ndarray]:
    """A scan as the sensor measures it, with points on its beams, and the time of each point
    relative to the scan."""
    rng = np.random.default_rng(seed)
    scan = random_scan(load_sensor(sensor), count, seed)
    distance = np.linalg.norm(scan.points, axis=1)
    scan = scan[(distance > 1) & (distance < 190)]
    scan.reflectance = (rng.integers(0, 256, len(scan)) / 255).astype(np.float32)
    return scan, rng.uniform(-0.1, 0.001, len(scan))


CUBOIDS = {
    "uuid": ["a-1", "b-2", "c-3", "d-4", "e-5"],
    "label": ["Car", "Pedestrian with Object", "Cones", "Bicycle", "Semi-truck"],
    "yaw": [0.3, -2.0, 0.1, 1.0, 3.0],
    "position.x": [4.0, -6.0, 8.0, -2.0, -8.0],
    "position.y": [12.0, 3.0, -9.0, 8.0, 22.0],
    "position.z": [0.9, 1.0, 0.3, 0.8, 1.9],
    "dimensions.x": [1.9, 0.7, 0.3, 0.6, 2.6],
    "dimensions.y": [4.6, 0.8, 0.3, 1.8, 14.0],
    "dimensions.z": [1.6, 1.8, 0.8, 1.7, 3.9],
    "cuboids.sensor_id": [-1, 0, -1, 1, 1],
    "attributes.rider_status": [None, None, None, "With Rider", None],
}
"""Cuboids in the world frame, as the table's columns."""


def write_pandaset(root: Path, count: int = 3) -> list[Path]:
    """A sequence with both sensors, labels, cuboids and a camera without images; the tables of the
    points."""
    folder = root / "007"
    times, poses = drive(max(count, 2))
    write_track(folder / "lidar", times, poses)
    write_track(folder / "camera" / "front_camera", times - 0.05, poses)
    (folder / "camera" / "front_camera" / "intrinsics.json").write_text(
        '{"fx": 1970, "fy": 1970, "cx": 970, "cy": 483}'
    )
    paths = [folder / "lidar" / f"{i:02d}.pkl.gz" for i in range(count)]
    for i, path in enumerate(paths):
        parts = []
        for device, name in enumerate(("pandar64", "pandar_gt")):
            scan, time = measured(i, name)
            moving = interpolate_poses(times, poses, times[i] + time) @ MOUNTS[name]
            world = (
                np.einsum(
                    "nij,nj->ni", moving[:, :3, :3], scan.points.astype(np.float64)
                )
                + moving[:, :3, 3]
            )
            intensity = np.round(scan.reflectance.astype(np.float64) * 255)
            parts.append(
                np.column_stack(
                    [world, intensity, times[i] + time, np.full(len(scan), device)]
                )
            )
        rows = np.concatenate(parts)
        write_table(
            path,
            dict(zip("xyzit", rows.T, strict=False))
            | {"d": rows[:, 5].astype(np.int64)},
        )
        classes = np.random.default_rng(i).integers(1, 43, len(rows))
        write_table(folder / "annotations" / "semseg" / path.name, {"class": classes})
        write_table(folder / "annotations" / "cuboids" / path.name, CUBOIDS)
    return paths
