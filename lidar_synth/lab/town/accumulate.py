"""The town's scans as accumulated, labelled clouds in KITTI-360's layout
(formats/kitti360_accumulated.py).

Made as the dataset's own tool makes them (kitti360Scripts, devkits/accumuLaser): points measured
from 3 to 30 m, thinned to 2 cm, the nearest measurement first; what moves is separate and carries
its frame. They are no copy of the scans' labels: only every second frame is accumulated, and with
errors of the poses, so that labels recovered from the clouds can be compared with those of frames
which the clouds hold and of frames which they do not hold.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import MAX_INSTANCES, MOVING
from lidar_synth.errors import ConfigError
from lidar_synth.formats.kitti360 import label_values
from lidar_synth.geometry import Scan
from lidar_synth.lab.kitti360.accumulated import REACH, SPACING, write_cloud
from lidar_synth.lab.town.town import Town
from lidar_synth.lab.town.world import STRETCH_FRAMES
from lidar_synth.noise import keyed_rng

STEP = 2
"""Every frame whose number is a multiple of this is accumulated."""

LENGTH = 12
STRIDE = 8
"""Frames of a window, and from the first frame of a window to that of the next."""

POSITION = 0.02
ANGLE = np.radians(0.03)
"""Standard deviations of the errors of the poses with which scans are accumulated, metres and
radians."""

MOST = 100_000.0
"""Maximum distance of a stretch from the origin, metres: farther, the layout's float32 would be
coarser than ``SPACING``."""

NEAREST = 3.0
"""Minimum distance from which a point is accumulated, metres."""

_POSE_ERRORS = 360  # part of the key of their random numbers


def check_accumulation(town: Town, layout: str) -> None:
    """Refuse what cannot be accumulated.

    Raises:
        ConfigError: on another layout than ``kitti360``, or scans farther off than ``MOST``.
    """
    most = int(MOST / town.apart) * STRETCH_FRAMES
    if layout != "kitti360" or len(town) > most:
        raise ConfigError(
            f"accumulated clouds of {len(town)} scans in layout {layout!r}",
            f"layout 'kitti360', whose float32 coordinates are exact enough for {most} scans",
            "Several towns (--seed) hold more.",
        )


def windows_of(town: Town) -> list[tuple[int, int]]:
    """First and last frame of each window of a town; no window crosses two stretches of road."""
    windows = []
    for begin in range(0, len(town), STRETCH_FRAMES):
        end = min(begin + STRETCH_FRAMES, len(town)) - 1
        starts = [
            s
            for s in range(begin, end + 1, STRIDE)
            if s == begin or s + LENGTH - STRIDE <= end
        ]
        windows += [(s, min(s + LENGTH - 1, end)) for s in starts]
    return windows


def window_paths(root: Path, drive: str, window: tuple[int, int]) -> tuple[Path, Path]:
    """The files of the static and of the moving points of a window."""
    folder = root / "data_3d_semantics" / "train" / drive
    name = f"{window[0]:010d}_{window[1]:010d}.ply"
    return folder / "static" / name, folder / "dynamic" / name


Cloud = dict[str, NDArray[Any]]
"""{property: (N,)}, as ``write_cloud`` takes it, and ``range``."""


def write_window(
    town: Town,
    root: Path,
    drive: str,
    window: tuple[int, int],
) -> None:
    """Write both files of a window, the static one last.

    Raises:
        FileError: if they cannot be written.
    """
    frames = range(window[0] + -window[0] % STEP, window[1] + 1, STEP)
    clouds = [
        _measured(town[i], i, keyed_rng(town.seed, _POSE_ERRORS, i)) for i in frames
    ]
    moving = _join([_thin({n: v[c["moving"]] for n, v in c.items()}) for c in clouds])
    static = _thin(_join([{n: v[~c["moving"]] for n, v in c.items()} for c in clouds]))
    for path, cloud in zip(
        window_paths(root, drive, window)[::-1], (moving, static), strict=True
    ):
        left_out = (
            ("range", "moving") if cloud is moving else ("range", "moving", "timestamp")
        )
        write_cloud(path, {n: v for n, v in cloud.items() if n not in left_out})


def _place(
    points: NDArray[np.float32], pose: NDArray[np.float64], rng: np.random.Generator
) -> Cloud:
    """Points of a scan in the world, with an error of the pose."""
    a, b, c = rng.normal(0, ANGLE, 3)
    turn = np.eye(3) + np.array(
        [
            (0, -c, b),
            (c, 0, -a),
            (-b, a, 0),
        ]
    )
    turned = points @ (pose[:3, :3] @ turn).T
    placed = turned + pose[:3, 3] + rng.normal(0, POSITION, 3)
    return dict(zip("xyz", placed.T, strict=True))


def _measured(scan: Scan, frame: int, rng: np.random.Generator) -> Cloud:
    """The points of a scan in the world, from ``NEAREST`` to ``REACH``, with an error of the
    pose."""
    assert scan.raw_label is not None and scan.pose is not None
    distance = np.linalg.norm(scan.points, axis=1)
    near = (distance > NEAREST) & (distance < REACH)
    values = label_values(scan)[near]
    semantic = (values & 0xFFFF).astype(np.int32)
    instance = (values >> 16).astype(np.int32)
    return _place(scan.points[near], scan.pose, rng) | {
        "semantic": semantic,
        "instance": np.where(instance > 0, instance, semantic * MAX_INSTANCES),
        "confidence": np.ones(len(values), np.float32),
        "timestamp": np.full(len(values), frame, np.int32),
        "moving": (scan.raw_label[near] & 0xFFFF) >= MOVING,
        "range": distance[near],
    }


def _join(clouds: list[Cloud]) -> Cloud:
    return {
        name: np.concatenate([cloud[name] for cloud in clouds]) for name in clouds[0]
    }


def _thin(cloud: Cloud) -> Cloud:
    """The point of each cube of ``SPACING`` that was measured from nearest, as in the dataset."""
    cubes = np.floor(np.column_stack([cloud[axis] for axis in "xyz"]) / SPACING).astype(
        np.int64
    )
    cubes -= cubes.min(axis=0, initial=0)
    order = np.argsort(cloud["range"], kind="stable")
    sides = cubes.max(axis=0, initial=0) + 1
    _, first = np.unique(
        np.ravel_multi_index(tuple(cubes[order].T), tuple(sides)), return_index=True
    )
    kept = np.sort(order[first])
    return {name: values[kept] for name, values in cloud.items()}
