"""The recorded frames of a set of scans, to detect evaluation of a model on its training data.

A frame is identified by dataset, drive and number. Names of splits are not sufficient: the training
data of LiDM (``lidm/train``) and the test data of R2Flow (``r2flow/test``) share two drives of
KITTI-360. Neither are names of datasets: the sequences of SemanticKITTI are those of KITTI's
odometry benchmark, which are parts of KITTI's raw drives. Both are therefore represented as raw
drives, by the table in the odometry devkit's readme (``ODOMETRY``). KITTI-360 was recorded two
years later and has no frames in common with them.

KITTI's object set was also sampled from the raw drives, in random order. Only its devkit (mapping/)
contains the mapping, so that the object set counts as a dataset of its own.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from lidar_synth.errors import parsing

KITTI360 = "KITTI-360"
KITTI = "KITTI"
KITTI_OBJECT = "KITTI object"
PANDASET = "PandaSet"
TOWN = "town"
FILES = "files"
CONTENT = "content"
"""Names of datasets. A drive of the town is a seed; a drive of ``FILES`` is a path with scans of an
unknown dataset; a drive of ``CONTENT`` is the hash of a single scan, wherever it lies."""

Frames = tuple[tuple[int, int], ...] | None
"""Frames of a drive as increasing intervals (first, last); None = all."""


def _drives(*drives: int) -> tuple[str, ...]:
    return tuple(f"2013_05_28_drive_{n:04d}_sync" for n in drives)


KITTI360_SPLITS: dict[str, tuple[str, ...] | None] = {
    "r2flow/train": _drives(3, 4, 5, 6, 7, 9, 10),
    "r2flow/test": _drives(0, 2),
    "lidm/train": _drives(0, 2, 4, 5, 6, 7, 8, 9, 10),
    "lidm/val": _drives(3),
    "lidm-camera/train": _drives(0, 4, 5, 6, 7, 8, 9, 10),
    "lidm-camera/val": _drives(3),
    "all": None,
}
"""Drives of KITTI-360's splits, named after the work that introduced each; None = all existing
drives."""

ODOMETRY = {
    "00": ("2011_10_03_drive_0027", 0, 4540),
    "01": ("2011_10_03_drive_0042", 0, 1100),
    "02": ("2011_10_03_drive_0034", 0, 4660),
    "03": ("2011_09_26_drive_0067", 0, 800),
    "04": ("2011_09_30_drive_0016", 0, 270),
    "05": ("2011_09_30_drive_0018", 0, 2760),
    "06": ("2011_09_30_drive_0020", 0, 1100),
    "07": ("2011_09_30_drive_0027", 0, 1100),
    "08": ("2011_09_30_drive_0028", 1100, 5170),
    "09": ("2011_09_30_drive_0033", 0, 1590),
    "10": ("2011_09_30_drive_0034", 0, 1200),
}
"""Raw drive, first and last frame of each sequence of the odometry benchmark; those of 11 to 21 are
not published."""

NOTE = ".sample.json"
"""The file beside generated scans with the settings of generation and the training data of the
model."""

MODELS = ".models.json"
"""The file beside converted scans with the provenances of the models that generated them."""

# Maximum number of intervals of a drive; more become one from the first frame to the last.
_MOST_RUNS = 200
_SHOWN = 6  # number of drives in a message


@dataclass(frozen=True)
class Recordings:
    """A set of recorded frames; ``|`` is the union of two sets, ``&`` their intersection.

    Args:
        drives: {(dataset, drive): frames}.
    """

    drives: Mapping[tuple[str, str], Frames] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return bool(self.drives)

    def __or__(self, other: "Recordings") -> "Recordings":
        joined = dict(self.drives)
        for key, theirs in other.drives.items():
            ours = joined.get(key, ())
            joined[key] = (
                None if theirs is None or ours is None else _merged([*ours, *theirs])
            )
        return Recordings(joined)

    def __and__(self, other: "Recordings") -> "Recordings":
        shared = {
            key: _shared(self.drives[key], other.drives[key])
            for key in self.drives
            if key in other.drives
        }
        return Recordings(
            {key: frames for key, frames in shared.items() if frames != ()}
        )

    def __str__(self) -> str:
        named = [
            f"{dataset} {drive} ({_in_words(frames)})"
            for (dataset, drive), frames in sorted(
                self.drives.items(), key=lambda d: d[0]
            )
        ]
        more = f" and {len(named) - _SHOWN} more drives" if len(named) > _SHOWN else ""
        return ", ".join(named[:_SHOWN]) + more

    def to_list(self) -> list[dict[str, Any]]:
        """Convert to plain values, for a checkpoint's provenance: for each dataset its drives, and
        for each drive the intervals (first, last) of its frames, or null for all frames."""
        values: dict[str, dict[str, list[list[int]] | None]] = {}
        for (dataset, drive), frames in sorted(self.drives.items(), key=lambda d: d[0]):
            values.setdefault(dataset, {})[drive] = (
                None if frames is None else [list(run) for run in frames]
            )
        return [
            {"dataset": dataset, "drives": drives} for dataset, drives in values.items()
        ]

    @classmethod
    def from_list(cls, values: Any) -> "Recordings":
        """The inverse of ``to_list``.

        Raises:
            DataError: on values of another form.
        """
        with parsing(
            f"recordings {str(values)[:200]}", "datasets, their drives and frames"
        ):
            drives = {
                (str(part["dataset"]), str(drive)): frames
                for part in values
                for drive, frames in part["drives"].items()
            }
            for key, frames in drives.items():
                if frames is not None:
                    drives[key] = _merged((int(a), int(b)) for a, b in frames)
            return cls(drives)


def all_frames(dataset: str, drives: Iterable[str]) -> Recordings:
    """All frames of some drives."""
    return Recordings({(dataset, drive): None for drive in drives})


def seen_by(provenance: Mapping[str, Any]) -> Recordings:
    """All recordings that influenced weights, also through teachers, initial weights and
    autoencoders.

    Raises:
        DataError: on invalid recordings.
    """
    return Recordings.from_list(provenance.get("seen", ())) | inherited(provenance)


def inherited(provenance: Mapping[str, Any]) -> Recordings:
    """The recordings behind the checkpoints that weights were trained from; raises as
    ``seen_by``."""
    seen = Recordings()
    for key, value in provenance.items():
        if key.endswith("_provenance") and isinstance(value, Mapping):
            seen |= seen_by(value)
    return seen


def frames_of(layout: str, ids: Iterable[str]) -> Recordings:
    """The recordings behind the ids of scans, or of whole drives.

    Args:
        layout: one of ``PLACES``; the result for any other layout is empty.
        ids: ``drive/frame`` of each scan in the layout's naming, or ``drive`` for all of its
            frames.
    """
    numbers: dict[str, set[str]] = {}
    for name in ids if layout in PLACES else ():
        drive, _, frame = name.partition("/")
        numbers.setdefault(drive, set()).add(frame)
    result = Recordings()
    for drive, frames in numbers.items():
        dataset, recorded, first, last = PLACES[layout](drive)
        known: Frames = None if last is None else ((first, last),)
        if all(frame.isdecimal() for frame in frames):
            known = _runs([first + int(frame) for frame in frames])
        result |= Recordings({(dataset, recorded): known})
    return result


Place = tuple[str, str, int, int | None]
"""Dataset, drive, and the numbers of the first and the last frame within the drive (None = to its
end)."""


def _sequence(name: str) -> Place:
    if name not in ODOMETRY:
        return KITTI, f"odometry {name}", 0, None
    drive, first, last = ODOMETRY[name]
    return KITTI, drive, first, last


PLACES: dict[str, Callable[[str], Place]] = {
    "kitti360": lambda drive: (KITTI360, drive, 0, None),
    "kitti_raw": lambda drive: (
        KITTI,
        drive.removesuffix("_sync").removesuffix("_extract"),
        0,
        None,
    ),
    "semantic_kitti": _sequence,
    "kitti_object": lambda part: (KITTI_OBJECT, part, 0, None),
    "pandaset": lambda sequence: (PANDASET, sequence, 0, None),
}
"""{layout: function from its drive to the recording}."""


def _runs(numbers: Sequence[int]) -> Frames:
    """Convert numbers of frames to intervals."""
    runs = _merged([(n, n) for n in numbers])
    return runs if len(runs) <= _MOST_RUNS else ((runs[0][0], runs[-1][1]),)


def _merged(runs: Iterable[tuple[int, int]]) -> tuple[tuple[int, int], ...]:
    """Sort intervals, and merge those that touch or overlap."""
    joined: list[tuple[int, int]] = []
    for first, last in sorted(runs):
        if joined and first <= joined[-1][1] + 1:
            joined[-1] = (joined[-1][0], max(last, joined[-1][1]))
        else:
            joined.append((first, last))
    return tuple(joined)


def _shared(some: Frames, others: Frames) -> Frames:
    """The intersection of two sets of frames."""
    if some is None or others is None:
        return others if some is None else some
    both = ((max(a, c), min(b, d)) for a, b in some for c, d in others)
    return _merged([(first, last) for first, last in both if first <= last])


def _in_words(frames: Frames) -> str:
    if frames is None:
        return "all frames"
    count = sum(last - first + 1 for first, last in frames)
    if count == 1:
        return f"frame {frames[0][0]}"
    return f"{count} frames from {frames[0][0]} to {frames[-1][1]}"
