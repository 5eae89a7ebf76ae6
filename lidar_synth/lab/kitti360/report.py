"""Counts of recovered labels, by class and by frame, and their report."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import IGNORE, NAMES, TRAIN_ID
from lidar_synth.errors import DataError

CLASS_COUNTS = ("points", "confidence", "known", "covered", "right")
"""Counts of each class: labelled points, the sum of their confidence, and, compared with known
labels of this class: all points, those that got a label, and those that got the right one."""


@dataclass
class LabelCounts:
    """The points of some scans.

    Args:
        scans: number of scans.
        fit: sum over the scans of the share of their upright points that lie on the clouds.
        points: all points.
        far: those without a neighbour in the clouds.
        disputed: those whose neighbours disagree.
        void: those whose neighbours have a class that is not trained.
        moving: those of moving objects.
        classes: {one of ``CLASS_COUNTS``: (19,)}.
        compared: {frame: known, covered and right points, and the same of moving cars}.
    """

    scans: int = 0
    fit: float = 0.0
    points: int = 0
    far: int = 0
    disputed: int = 0
    void: int = 0
    moving: int = 0
    classes: dict[str, NDArray[np.float64]] = field(
        default_factory=lambda: {name: np.zeros(len(NAMES)) for name in CLASS_COUNTS}
    )
    compared: dict[int, list[int]] = field(default_factory=dict)

    def count(
        self,
        train: NDArray[np.uint8],
        confidence: NDArray[np.float32],
        *,
        fit: float,
        far: int,
        disputed: int,
        moving: int,
    ) -> None:
        """Add a scan: (N,) train ids and confidence; its fit, and numbers of points as in the
        class."""
        labelled = train != IGNORE
        self.scans += 1
        self.fit += fit
        self.points += len(train)
        self.far += far
        self.disputed += disputed
        self.void += len(train) - int(labelled.sum()) - far - disputed
        self.moving += moving
        self.classes["points"] += _by_class(train)
        self.classes["confidence"] += _by_class(train, confidence)

    def compare(
        self,
        frame: int,
        train: NDArray[np.uint8],
        truth: NDArray[np.uint8],
        moving: NDArray[np.bool_],
    ) -> None:
        """Add the comparison of a scan with its known train ids (N,); ``moving`` marks what
        moves."""
        known = truth != IGNORE
        covered = known & (train != IGNORE)
        masks = [known, covered, covered & (truth == train)]
        for name, mask in zip(CLASS_COUNTS[2:], masks, strict=True):
            self.classes[name] += _by_class(truth[mask])
        cars = moving & (truth == TRAIN_ID["car"])
        masks += [cars & mask for mask in masks]
        self.compared[frame] = [int(mask.sum()) for mask in masks]

    def __iadd__(self, other: "LabelCounts") -> "LabelCounts":
        for name in ("scans", "fit", "points", "far", "disputed", "void", "moving"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        for name, values in other.classes.items():
            self.classes[name] = self.classes[name] + values
        return self

    def to_dict(self) -> dict[str, Any]:
        """Plain values; ``from_dict`` is the inverse."""
        return vars(self) | {
            "classes": {name: values.tolist() for name, values in self.classes.items()}
        }

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> "LabelCounts":
        """The inverse of ``to_dict``, also after a round trip through JSON.

        Raises:
            DataError: on other values.
        """
        try:
            classes = {
                name: np.array(values["classes"][name], np.float64)
                for name in CLASS_COUNTS
            }
            compared = {
                int(frame): [int(n) for n in counts]
                for frame, counts in values["compared"].items()
            }
            return cls(**values | {"classes": classes, "compared": compared})
        except (TypeError, KeyError, ValueError, AttributeError) as error:
            given = f"counts of labels {str(values)[:200]} ({error!r})"
            raise DataError(given, "those that this package wrote") from error


@dataclass
class LabelReport:
    """The result of a run.

    Args:
        without_pose, outside: {drive: frames without labels because they have no pose, or lie in no
            window}.
        without_clouds: drives without windows.
        labelled: {drive: number of frames with labels}.
        misfits: {drive: frames whose scans do not lie on the clouds}.
        moved: {drive: metres by which scans were laid onto the clouds, of those that lay off}.
        kept: number of windows that were complete before this run.
        counts: of all labelled frames.
        compared: {drive/frame: see ``LabelCounts``}.
    """

    without_pose: dict[str, int]
    outside: dict[str, int]
    without_clouds: tuple[str, ...]
    labelled: dict[str, int] = field(default_factory=dict)
    misfits: dict[str, list[int]] = field(default_factory=dict)
    moved: dict[str, list[float]] = field(default_factory=dict)
    kept: int = 0
    counts: LabelCounts = field(default_factory=LabelCounts)
    compared: dict[str, list[int]] = field(default_factory=dict)

    def add(self, drive: str, record: dict[str, Any]) -> None:
        """Add the record of a window."""
        own = LabelCounts.from_dict(record["counts"])
        self.counts += own
        self.compared |= {
            f"{drive}/{frame:010d}": counts for frame, counts in own.compared.items()
        }
        self.labelled[drive] = self.labelled.get(drive, 0) + len(record["fitting"])
        self.misfits.setdefault(drive, []).extend(record["misfits"])
        self.moved.setdefault(drive, []).extend(record["moved"].values())
        self.kept += bool(record.get("kept"))

    def check(self) -> None:
        """Refuse a drive of which most scans do not lie on the clouds.

        Raises:
            DataError: if there is one.
        """
        for drive, frames in self.misfits.items():
            if len(frames) > self.labelled[drive]:
                raise DataError(
                    f"{len(frames)} of {len(frames) + self.labelled[drive]} scans of {drive} do "
                    "not lie on its accumulated clouds",
                    "poses, calibration, scans and clouds of the same drive",
                    "Check data_poses and calibration; those scans got no labels.",
                )

    def totals(self) -> dict[str, float]:
        """Shares of all points, and, if known labels were compared, of the points that have one."""
        counts = self.counts
        points = max(counts.points, 1)
        shares = {
            "on_clouds": counts.fit / max(counts.scans, 1),
            "labelled": float(counts.classes["points"].sum()) / points,
        }
        for name in ("far", "disputed", "void", "moving"):
            shares[name] = getattr(counts, name) / points
        if self.compared:
            known, covered, right, *cars = np.sum(
                list(self.compared.values()), axis=0
            ).tolist()
            shares |= {
                "covered": covered / max(known, 1),
                "right": right / max(covered, 1),
                "cars_covered": cars[1] / max(cars[0], 1),
                "cars_right": cars[2] / max(cars[1], 1),
            }
        return shares

    def classes(self) -> dict[str, dict[str, float | int | None]]:
        """{class: labelled points, mean confidence, and the shares of known points that were
        covered and right}."""
        table: dict[str, dict[str, float | int | None]] = {}
        for i, name in enumerate(NAMES):
            points, confidence, known, covered, right = (
                float(self.counts.classes[n][i]) for n in CLASS_COUNTS
            )
            if points or known:
                table[name] = {
                    "points": int(points),
                    "confidence": round(confidence / points, 4) if points else None,
                    "covered": round(covered / known, 4) if known else None,
                    "right": round(right / covered, 4) if covered else None,
                }
        return table

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "frames": {
                "labelled": self.labelled,
                "without_pose": self.without_pose,
                "outside_windows": self.outside,
                "not_on_the_clouds": self.misfits,
                "laid_onto_the_clouds": {
                    drive: len(metres) for drive, metres in self.moved.items()
                },
                "drives_without_clouds": list(self.without_clouds),
            },
            "points": self.counts.points,
            "shares": {name: round(share, 4) for name, share in self.totals().items()},
            "classes": self.classes(),
            "compared": self.compared,
        }


def _by_class(
    train: NDArray[np.uint8], weights: NDArray[np.float32] | None = None
) -> NDArray[np.float64]:
    known = train != IGNORE
    part = None if weights is None else weights[known]
    return np.bincount(train[known], part, len(NAMES)).astype(np.float64)
