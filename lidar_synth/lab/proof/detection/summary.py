"""From detections to what can be said: average precision by criterion, and paired differences with
intervals over places and seeds."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lidar_synth.lab.proof.detection.arms import ARMS, BASE
from lidar_synth.lab.proof.detection.bev import Found
from lidar_synth.lab.proof.detection.boxes import CLASSES
from lidar_synth.lab.proof.detection.scores import (
    Criterion,
    Judged,
    Truth,
    judge,
    precision_of,
)
from lidar_synth.lab.proof.scores import FEWEST_PLACES, expanded_quantiles

CRITERIA = {
    "overlap 0.5": Criterion(0.5),
    "overlap 0.3": Criterion(0.3),
    **{f"centre {far:g} m": Criterion(distance=far) for far in (0.5, 1, 2, 4)},
    "overlap 0.5, 0 to 20 m": Criterion(0.5, far=20),
    "overlap 0.5, 20 to 35 m": Criterion(0.5, near=20, far=35),
    "overlap 0.5, over 35 m": Criterion(0.5, near=35),
}
MAIN = "overlap 0.5"
"""The criterion of the paired differences."""
DRAWS = 2000

Outcomes = Mapping[int, Mapping[int, Found]]
"""{seed: {index of a tested scan: what is found in it}} of an arm."""
Tested = Mapping[int, Mapping[str, Sequence[int]]]
"""{seed: {place: indices of its scans}}."""
Groups = list[list[list[Judged]]]
"""The judged scans by seed and place."""


def summarise(
    found: Mapping[str, Outcomes],
    truths: Mapping[int, Truth],
    tested: Tested,
) -> dict[str, Any]:
    """The values of a comparison, by class; percent.

    Args:
        found: {arm: outcomes}; ``BASE`` is one of them.
        truths: the boxes of every scan by its index.
        tested: what each seed tests on; classes without a box there are left out.
    """
    wanted = {
        number
        for places in tested.values()
        for scans in places.values()
        for i in scans
        for number in truths[i].classes[truths[i].wanted].tolist()
    }
    names = list(CLASSES)
    return {
        "arms": [
            {"arm": arm, "title": ARMS[arm].title, "budget": ARMS[arm].budget}
            for arm in found
        ],
        "places": {
            name: len(scans) for part in tested.values() for name, scans in part.items()
        },
        "classes": {
            names[each]: _of_class(found, truths, tested, each)
            for each in sorted(wanted)
        },
    }


def _of_class(
    found: Mapping[str, Outcomes],
    truths: Mapping[int, Truth],
    tested: Tested,
    each: int,
) -> dict[str, Any]:
    """{arm: its figures} for one class."""
    judged = {
        arm: {
            name: _groups(outcomes, truths, tested, each, criterion)
            for name, criterion in CRITERIA.items()
        }
        for arm, outcomes in found.items()
    }
    base = judged[BASE][MAIN]
    table = {}
    for arm, groups in judged.items():
        own = groups[MAIN]
        changes = [_percent(a) - _percent(b) for a, b in zip(own, base, strict=True)]
        by_place = _by_place(own, tested)
        places = sum(value is not None for value in by_place.values())
        other = arm != BASE
        enough = other and places >= FEWEST_PLACES
        table[arm] = {
            "by_seed": [_mean([one]) for one in own],
            "difference": round(float(np.nanmean(changes)), 1) if other else None,
            "interval": interval_of(own, base, tested) if enough else None,
            "by_place": by_place,
            **{name: _mean(one) for name, one in groups.items()},
        }
    wanted = [sum(one.wanted for place in seed for one in place) for seed in base]
    return {"boxes": wanted, "arms": table}


def _by_place(groups: Groups, tested: Tested) -> dict[str, float | None]:
    """{place: average precision there}, mean over the seeds that test it; None without a box."""
    values: dict[str, Groups] = {}
    for seed, places in zip(groups, tested.values(), strict=True):
        for place, judged in zip(places, seed, strict=True):
            values.setdefault(place, []).append([judged])
    return {place: _mean(found) for place, found in values.items()}


def _groups(
    outcomes: Outcomes,
    truths: Mapping[int, Truth],
    tested: Tested,
    each: int,
    criterion: Criterion,
) -> Groups:
    return [
        [
            [judge(outcomes[seed][i], truths[i], each, criterion) for i in scans]
            for scans in places.values()
        ]
        for seed, places in tested.items()
    ]


def _percent(places: Sequence[Sequence[Judged]]) -> float:
    return 100 * precision_of([one for place in places for one in place])


def _mean(groups: Groups) -> float | None:
    """Mean over seeds; None without a box."""
    values = [value for seed in groups if not np.isnan(value := _percent(seed))]
    return round(float(np.mean(values)), 1) if values else None


def interval_of(own: Groups, base: Groups, tested: Tested) -> tuple[float, float]:
    """95 % interval of the mean difference of two arms, percentage points, by a bootstrap over
    seeds and, for all of them together, over tested places.

    The average precision is of all drawn places together.
    """
    rng = np.random.default_rng(0)
    places = list(map(list, tested.values()))
    names = sorted(set[str]().union(*places))

    def draw() -> list[float]:
        drawn = rng.choice(names, len(names))
        changes = []
        for seed in rng.integers(0, len(places), len(places)):
            kept = [places[seed].index(name) for name in drawn if name in places[seed]]
            made, before = ([arm[seed][i] for i in kept] for arm in (own, base))
            changes.append(_percent(made) - _percent(before))
        return changes

    # A seed without a drawn place with a box has no difference.
    drawn = np.ma.masked_invalid([draw() for _ in range(DRAWS)]).mean(1).compressed()
    low, high = np.quantile(drawn, expanded_quantiles(len(names)))
    return round(float(low), 1), round(float(high), 1)
