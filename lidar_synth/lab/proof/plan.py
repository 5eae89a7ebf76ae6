"""The plan of a comparison: places, labelled scans and trainings.

A *pair* is a place that is left out and a seed; it has one training of every arm, on the same
labelled scans. Only whole pairs are compared.
"""

from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from lidar_synth.datasets.recordings import Recordings
from lidar_synth.files.disk import hash_of_names
from lidar_synth.geometry import Sensor, spread
from lidar_synth.lab.proof.arms import CONSTANTS, Row
from lidar_synth.lab.proof.places import Places
from lidar_synth.lab.proof.pools import MOST_SKIN_SCANS
from lidar_synth.lab.proof.scores import Groups
from lidar_synth.lab.proof.settings import ProofSettings

Pair = tuple[str, int]
"""The place that is left out, and the seed."""

FORMAT = "lidar-synth-proof/8"


@dataclass(frozen=True)
class ProofPlan:
    """All that is known before the first training.

    Args:
        settings: what was asked for.
        places: {name: indices of its scans}.
        names: of all scans.
        sensor: of the scans, with the beams that they keep.
        grid: on which they are thinned; None to keep all returns.
        rows: the arms.
        groups: the scored classes.
        absent: those that no label has.
        pairs: in the order in which they are trained.
        wanted: number of pairs without a limit of time.
        labelled: {pair: indices of the labelled scans that are trained on}.
        tested: {place: indices of the scans that are tested on}.
        training: the places of the labelled scans, if others are tested; None where each place is
            left out in turn.
        recordings: of the tested scans.
        half: whether the reference network computes in bfloat16.
        step: seconds of one of its iterations.
        minutes: expected for all pairs, with ``jobs`` processes.
        jobs: processes.
        device: on which the reference network computes.
        options: how the labelled scans are read, as ``ScanFiles.options``.
    """

    settings: ProofSettings
    places: Places
    names: tuple[str, ...]
    sensor: Sensor
    grid: Sensor | None
    rows: list[Row]
    groups: Groups
    absent: list[str]
    pairs: list[Pair]
    wanted: int
    labelled: dict[Pair, list[int]]
    tested: dict[str, list[int]]
    training: Places | None
    recordings: Recordings
    half: bool
    step: float
    minutes: float
    jobs: int
    device: str
    options: dict[str, Any]

    @property
    def budget(self) -> str:
        """How many labelled scans a training gets, as ``count_scans``."""
        return count_scans([*map(len, self.labelled.values())], "labelled scan")

    def skin_scans(self, place: str) -> list[int]:
        """Indices of the scans, of other places than this, that a skin is learnt from; their labels
        are not used."""
        others = self.training
        if others is None:
            others = {n: part for n, part in self.places.items() if n != place}
        indices = [i for members in others.values() for i in members]
        return spread(indices, MOST_SKIN_SCANS)

    def trainings(self, pairs: Sequence[Pair]) -> list[list[Pair]]:
        """The pairs that each training serves: one, or all places of a seed where no place is left
        out."""
        served: dict[Any, list[Pair]] = {}
        for pair in pairs:
            served.setdefault(pair if self.training is None else pair[1], []).append(
                pair
            )
        return list(served.values())

    def seconds(self, row: Row) -> float:
        """Expected seconds of the iterations of a training."""
        return self.settings.iterations * row.arm.iterations * self.step

    def identity(self) -> dict[str, Any]:
        """Plain values that determine every training, to tell whether one that exists may be
        kept."""
        own = asdict(self.settings)
        # They add trainings, or score the same ones.
        free = (
            "arms",
            "ratios",
            "seeds",
            "classes",
            "only",
        )
        if self.settings.beams is None:
            own.pop("beams")  # comparisons of earlier versions do not have it
        return {
            "format": FORMAT,
            "scans": hash_of_names(self.names),
            "sensor": self.sensor.to_dict(),
            "half": self.half,
            **{name: value for name, value in own.items() if name not in free},
            **({} if self.training is None else {"tested": sorted(self.places)}),
            **self.options,
        }


def count_scans(numbers: Collection[int], kind: str) -> str:
    """Numbers of scans in words, such as "1 labelled scan" or "2 to 7 labelled scans"."""
    low = min(numbers)
    high = max(numbers)
    text = f"{low}" if low == high else f"{low} to {high}"
    return f"{text} {kind}{'s' * (high != 1)}"


def describe(plan: ProofPlan) -> str:
    """The plan in words, for a user who decides whether to start it."""
    tested = sorted({place for place, _ in plan.pairs})
    where = (
        "a place that was left out" if plan.training is None else "all tested places"
    )
    lines = [
        f"{len(plan.names)} scans of {plan.sensor.name} in {len(plan.places)} places: "
        + ", ".join(
            f"{name} ({len(members)})" for name, members in plan.places.items()
        ),
        f"each training gets {plan.budget} and is tested on {where}",
        f"tested places: {', '.join(tested)}; seeds: {len({seed for _, seed in plan.pairs})}; "
        f"{len(plan.pairs)} of {plan.wanted} pairs of place and seed",
        f"classes without a label: {', '.join(plan.absent) or 'none'}",
        "trainings of each pair:",
    ]
    for row in plan.rows:
        count = round(plan.settings.iterations * row.arm.iterations)
        uses = f" (uses {row.arm.budget})" if row.arm.budget else ""
        lines.append(
            f"  {row.key:<20}{count} iterations of {plan.settings.batch}: {row.title}{uses}"
        )
    time = (
        f"about {plan.minutes:.0f} minutes with {plan.jobs} processes"
        if plan.step
        else "time: that of your trainer"
    )
    count = len(plan.rows) * len(plan.trainings(plan.pairs))
    # The same words for every arm, once below.
    parts = "\n".join([*lines, f"{count} trainings; {time}"]).split(CONSTANTS)
    note = f"\nlabels of the town{CONSTANTS}" if len(parts) > 1 else ""
    return "".join(parts) + note
