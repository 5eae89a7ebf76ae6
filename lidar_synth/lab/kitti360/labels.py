"""Labels per scan for KITTI-360, from its accumulated clouds; in parallel, resumable.

Output, which ``KITTI360(out)`` reads::

    data_3d_semantics_scan/DRIVE/labels/FFFFFFFFFF.label    uint32 per point: KITTI-360's id,
                                                            instance above; 0 = none
    data_3d_semantics_scan/DRIVE/confidence/FFFFFFFFFF.bin  uint8 per point: 255 times the
                                                            confidence of the label
    data_3d_semantics_scan/DRIVE/windows/WINDOW.json        counts of a complete window, and what it
                                                            was made of
    data_3d_semantics_scan/report.json                      the dataset's root, and counts of all
                                                            windows

The unit of work is a window. A rerun repeats windows without a record, and those whose clouds,
poses or boxes changed. A frame gets labels if a window covers it, it has a pose (or the car hardly
moved between two poses), and its scan lies on the clouds, or could be laid onto them; frames
without labels have no file.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from lidar_synth.datasets.classes import KITTI360 as CLASSES
from lidar_synth.errors import ConfigError, DataError, FileError, check_count
from lidar_synth.files.disk import read_text, remove_file, sha256, write_file
from lidar_synth.files.parsing import parse_json
from lidar_synth.files.processes import map_in_processes
from lidar_synth.formats.kitti360 import (
    LABELLED,
    boxes_path,
    confidence_path,
    drives_of,
    frames_of,
    labels_folder,
    read_scan_labels,
    scans_folder,
)
from lidar_synth.formats.kitti360_boxes import WorldBoxes, read_boxes
from lidar_synth.formats.kitti360_poses import fill_poses, read_calibration, read_poses
from lidar_synth.formats.point_labels import write_labels
from lidar_synth.formats.points import read_points
from lidar_synth.lab.kitti360.accumulated import Window, find_windows
from lidar_synth.lab.kitti360.movers import find_inside
from lidar_synth.lab.kitti360.recovery import Recovery
from lidar_synth.lab.kitti360.report import LabelCounts, LabelReport

VERSION = 2
"""Raised when the rules change, so that a rerun replaces labels of older versions."""

_SAMPLES = (
    8  # scans of a window on which it is tested whether they are motion-compensated
)
_OBJECTS = np.isin(np.arange(256), range(8))  # train ids of what can move


@dataclass(frozen=True)
class WindowJob:
    """The frames of a drive that one window labels.

    Args:
        drive: the drive's folder name.
        windows: the window and its neighbours.
        window: the window itself.
        frames: the frames.
    """

    drive: str
    windows: tuple[Window, ...]
    window: Window
    frames: tuple[int, ...]


@dataclass(frozen=True)
class Plan:
    """What there is to do.

    Args:
        jobs: one for each window that has frames to label.
        without_pose: {drive: number of frames inside a window that have no pose}.
        outside: {drive: number of frames outside all windows}.
        without_clouds: drives that have scans, but no window.
    """

    jobs: tuple[WindowJob, ...]
    without_pose: dict[str, int]
    outside: dict[str, int]
    without_clouds: tuple[str, ...]

    @property
    def frames(self) -> int:
        """Number of frames to label."""
        return sum(len(job.frames) for job in self.jobs)


def plan_labels(root: str | Path, split: str = "all") -> Plan:
    """Assign the frames of KITTI-360's drives to windows.

    A frame inside two windows belongs to the one whose ends are farther away.

    Args:
        root: the dataset's folder.
        split: the drives, as for ``KITTI360``.

    Raises:
        ConfigError: on an unknown split.
        DataError: if no drive of the split has windows, or one with windows has no poses; on a bad
            file.
    """
    root = Path(root)
    jobs: list[WindowJob] = []
    without_pose = {}
    outside = {}
    without_clouds = []
    for drive in drives_of(root, split):
        windows = find_windows(root, drive)
        if not windows:
            without_clouds.append(drive)
            continue
        frames = frames_of(root, drive)
        poses = _poses(root, drive)
        if not poses:
            raise DataError(
                f"{drive} has no poses",
                f"{root / 'data_poses' / drive / 'poses.txt'} and calibration/",
            )
        owner = {f: _owner(windows, f) for f in frames}
        placed = fill_poses(poses, [f for f in frames if owner[f] is not None])
        outside[drive] = sum(owner[f] is None for f in frames)
        without_pose[drive] = len(frames) - outside[drive] - len(placed)
        for i, window in enumerate(windows):
            own = tuple(f for f in placed if owner[f] == i)
            if own:
                jobs.append(
                    WindowJob(drive, tuple(windows[max(i - 1, 0) : i + 2]), window, own)
                )
    if not jobs:
        raise DataError(
            f"{root} has no frame inside an accumulated cloud ({len(without_clouds)} drives "
            "without clouds, "
            f"{sum(outside.values())} frames outside, {sum(without_pose.values())} without a pose)",
            "data_3d_semantics/train/DRIVE/static/FFFFFFFFFF_LLLLLLLLLL.ply",
            "Download 'Accumulated Point Clouds for Train & Val' and unpack it into the "
            "dataset's folder.",
        )
    return Plan(tuple(jobs), without_pose, outside, tuple(without_clouds))


def _owner(windows: Sequence[Window], frame: int) -> int | None:
    covering = [i for i, w in enumerate(windows) if w.first <= frame <= w.last]
    return max(
        covering,
        key=lambda i: min(frame - windows[i].first, windows[i].last - frame),
        default=None,
    )


def label_scans(
    root: str | Path,
    out: str | Path,
    *,
    split: str = "all",
    against: str | Path | None = None,
    jobs: int = 1,
    progress: bool = True,
) -> LabelReport:
    """Recover labels for the scans of KITTI-360; a rerun resumes an interrupted run.

    Args:
        root: the dataset's folder, with scans, poses, calibration, accumulated clouds and, for
            moving objects, boxes.
        out: the folder to write to; it may be ``root``.
        split: the drives, as for ``KITTI360``.
        against: a folder with known labels in ``data_3d_semantics_scan``, to which the recovered
            ones are compared.
        jobs: number of processes; each holds the clouds of one window and its neighbours.
        progress: whether to show a progress bar.

    Raises:
        ConfigError: on an unknown split, less than one job, or an output folder with labels from
            elsewhere.
        DataError: as ``plan_labels``; also if most frames of a drive do not lie on its clouds.
        FileError: if the output cannot be written.
    """
    root = Path(root)
    out = Path(out)
    check_count("jobs", jobs, 1)
    for cached in (_poses, _boxes, _hash):
        cached.cache_clear()  # files may have changed since an earlier call
    plan = plan_labels(root, split)
    for drive in {job.drive for job in plan.jobs}:
        _claim(labels_folder(out, drive))
    work = partial(_label_window, root, out, None if against is None else Path(against))
    report = LabelReport(plan.without_pose, plan.outside, plan.without_clouds)
    with (
        tqdm(total=plan.frames, unit="scan", disable=not progress) as bar,
        map_in_processes(work, plan.jobs, jobs) as results,
    ):
        for job, record in zip(plan.jobs, results, strict=True):
            report.add(job.drive, record)
            bar.update(len(job.frames))
    write_file(
        out / LABELLED / "report.json",
        json.dumps({"root": str(root.resolve())} | report.to_dict(), indent=1).encode(),
    )
    report.check()
    return report


def _claim(labels: Path) -> None:
    """Mark a folder of labels as one of this command, before there is a label, so that a killed run
    can be resumed."""
    records = labels.parent / "windows"
    if labels.is_dir() and not records.is_dir():
        raise ConfigError(
            f"{labels} holds labels from elsewhere", "a folder without labels"
        )
    try:
        records.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileError(
            f"{records} cannot be made ({error.strerror})",
            "a folder to write labels to",
        ) from error


def _label_window(
    root: Path, out: Path, against: Path | None, job: WindowJob
) -> dict[str, Any]:
    """Label the frames of a window, unless its record shows that this is done; return the
    record."""
    folder = labels_folder(out, job.drive)
    path = folder.parent / "windows" / f"{job.window.name}.json"
    made_of = _inputs(root, against, job)
    record = _read_record(path)
    names = [f"{int(frame):010d}" for frame in record.get("fitting", ())]
    before = record.get("inputs", {})
    # labels that were compared are the same without
    given = {} if against else {"against": before.get("against")}
    if before == made_of | given and all(
        (folder / f"{name}.label").is_file()
        and confidence_path(out, job.drive, name).is_file()
        for name in names
    ):
        return record | {"kept": True}
    poses = fill_poses(
        _poses(root, job.drive), range(min(job.frames) - 1, max(job.frames) + 2)
    )
    recovery = Recovery(job.windows, _boxes(root, job.drive), poses, job.frames)
    points = partial(_points, root, job.drive)
    apart = -(-len(job.frames) // _SAMPLES)
    recovery.choose_motion({f: points(f)[:, :3] for f in job.frames[::apart]})
    for frame in job.frames:  # labels of an earlier run with other clouds or poses
        remove_file(folder / f"{frame:010d}.label")
    counts = LabelCounts()
    fitting = []
    misfits = []
    moved = {}
    for frame in job.frames:
        scan = points(frame)[:, :3]
        found = recovery.label(scan, frame)
        if not found.fits:
            misfits.append(frame)
            continue
        fitting.append(frame)
        if found.moved:
            moved[frame] = round(found.moved, 3)
        name = f"{frame:010d}"
        write_file(
            confidence_path(out, job.drive, name),
            np.rint(found.confidence * 255).astype(np.uint8).tobytes(),
        )
        write_labels(folder / f"{name}.label", found.values)
        train = CLASSES.decode((found.values & 0xFFFF).astype(np.uint16))
        reasons = {"far": found.far, "disputed": found.disputed, "moving": found.moving}
        counts.count(train, found.confidence, fit=found.fit, **reasons)
        if against is not None:
            truth = read_scan_labels(against, job.drive, name, folder, len(scan)).get(
                "label"
            )
            if truth is not None:
                counts.compare(
                    frame, train, truth, _moving(recovery, scan, frame, truth)
                )
    record = {
        "inputs": made_of,
        "turns": recovery.turns,
        "fitting": fitting,
        "misfits": misfits,
    }
    record |= {"moved": moved, "counts": counts.to_dict()}
    write_file(path, json.dumps(record).encode())
    return record


def _moving(
    recovery: Recovery, scan: NDArray[np.float32], frame: int, truth: NDArray[np.uint8]
) -> NDArray[np.bool_]:
    """Which points belong to moving objects, by their known class and the boxes that move."""
    placed = recovery.place(scan, frame)
    moving = np.zeros(len(scan), bool)
    for track in recovery.movers.present(frame):
        moving[find_inside(track.boxes[frame], placed, 0.1)] = True
    return moving & _OBJECTS[truth]


def _inputs(root: Path, against: Path | None, job: WindowJob) -> dict[str, Any]:
    """What the labels of a window depend on."""
    files: list[Path] = []
    for window in job.windows:
        both = (window.static, window.dynamic)
        files += [path for path in both if path is not None]
    boxes = boxes_path(root, job.drive)
    return {
        "version": VERSION,
        "frames": [job.frames[0], job.frames[-1], len(job.frames)],
        "sizes": [
            [f"{p.parent.name}/{p.name}", p.stat().st_size]
            for p in (*files, *([boxes] if boxes else []))
        ],
        "poses": _hash(root / "data_poses" / job.drive / "poses.txt"),
        "calibration": {
            p.name: _hash(p) for p in sorted((root / "calibration").glob("*.txt"))
        },
        "against": None if against is None else str(against.resolve()),
    }


def _read_record(path: Path) -> dict[str, Any]:
    if not path.is_file():
        return {}
    record = parse_json(read_text(path), str(path), "the record of a window")
    kinds = {"inputs": dict, "fitting": list}
    if isinstance(record, dict) and all(
        isinstance(record.get(name), kind) for name, kind in kinds.items()
    ):
        return record
    return {}


def _points(root: Path, drive: str, frame: int) -> NDArray[np.float32]:
    return read_points(scans_folder(root, drive) / f"{frame:010d}.bin")


@lru_cache(maxsize=1)
def _poses(root: Path, drive: str) -> dict[int, NDArray[np.float64]]:
    return read_poses(root, drive, read_calibration(root))


@lru_cache(maxsize=1)
def _boxes(root: Path, drive: str) -> WorldBoxes | None:
    path = boxes_path(root, drive)
    return None if path is None else read_boxes(path)


_hash = lru_cache(maxsize=4)(sha256)
