"""From confusion tables to what can be said: IoU by class, paired differences, and intervals over
places and seeds."""

from collections.abc import Mapping, Sequence
from math import sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, stdtrit

from lidar_synth.datasets.classes import NAMES, TRAIN_ID
from lidar_synth.errors import DataError, choose

Groups = Mapping[str, Sequence[str]]
"""{name: classes that count as one}; labels of other classes do not count."""

GROUPS: dict[str, Groups] = {
    "semantic_kitti": {name: (name,) for name in NAMES},
    "pandaset": {
        "vehicle": ("car", "truck", "other-vehicle"),
        "two-wheeler": ("bicycle", "motorcycle", "bicyclist", "motorcyclist"),
        "person": ("person",),
        "road": ("road",),
        "walkable": ("sidewalk", "parking", "other-ground", "terrain"),
        "building": ("building",),
        "fence": ("fence",),
        "vegetation": ("vegetation", "trunk"),
        "traffic-sign": ("traffic-sign",),
    },
    "kitti360": {
        **{
            name: (name,)
            for name in NAMES
            if name not in ("bicyclist", "motorcyclist", "vegetation", "trunk")
        },
        "rider": ("bicyclist", "motorcyclist"),
        "vegetation": ("vegetation", "trunk"),
    },
    "nuscenes": {
        "car": ("car",),
        "truck": ("truck",),
        "other-vehicle": ("other-vehicle",),
        "two-wheeler": ("bicycle", "motorcycle", "bicyclist", "motorcyclist"),
        "person": ("person",),
        "road": ("road",),
        "walkable": ("sidewalk", "parking"),
        "other-ground": ("other-ground",),
        "manmade": ("building", "pole", "traffic-sign"),
        "fence": ("fence",),
        "vegetation": ("vegetation", "trunk"),
        "terrain": ("terrain",),
    },
}
"""The classes that a dataset labels as the package does, once they are pooled; by its layout."""

FEWEST_PLACES = 6
"""Places from which an interval is given: with fewer, even the range of all differences is no 95 %
interval."""
DRAWS = 10_000


def groups_of(classes: str, only: Sequence[str] = ()) -> Groups:
    """The classes that are scored.

    Args:
        classes: a name of ``GROUPS``.
        only: names of some of them; all by default.

    Raises:
        ConfigError: on an unknown name.
    """
    groups = choose("classes", classes, GROUPS)
    for name in only:
        choose(f"class of {classes}", name, groups)
    return {
        name: members for name, members in groups.items() if not only or name in only
    }


def require_labels(
    table: NDArray[np.int64], groups: Groups, only: Sequence[str]
) -> list[str]:
    """The names of the groups that no label has.

    Args:
        table: (19,) number of labels by class, in all places.
        groups: what is scored.
        only: the groups that the user asked for by name.

    Raises:
        DataError: if none of the groups, or one that was asked for, is labelled.
    """
    absent = [
        name
        for name, members in groups.items()
        if not sum(table[TRAIN_ID[m]] for m in members)
    ]
    if missing := [name for name in absent if name in only]:
        raise DataError(
            f"class {', '.join(missing)}, which no label of your scans has",
            "classes that are labelled",
            f"These are: {', '.join(n for n in groups if n not in absent) or 'none'}.",
        )
    if len(absent) == len(groups):
        raise DataError(
            "scans without a label of any scored class",
            "labelled scans",
            "Check --classes, and the table of labels.",
        )
    return absent


def group_ious(table: NDArray[np.int64], groups: Groups) -> NDArray[np.float64]:
    """(G,) IoU of every group from a confusion table (19, 19); NaN for a group that no label
    has."""
    count = len(groups)
    group = np.full(len(NAMES), count)
    for i, members in enumerate(groups.values()):
        group[[TRAIN_ID[name] for name in members]] = i
    small = np.zeros((count + 1, count + 1), np.int64)
    np.add.at(small, (group[:, None], group[None]), table)
    # labels of no group do not count; predictions of no group do, as errors
    small = small[:count]
    hits = np.diagonal(small)
    union = small.sum(1) + small[:, :count].sum(0) - hits
    return np.where(small.sum(1) > 0, hits / np.maximum(union, 1), np.nan)


def mean_group_iou(table: NDArray[np.int64], groups: Groups) -> float:
    """Mean IoU over the groups that occur in the labels, in [0, 1]; NaN if none does."""
    ious = group_ious(table, groups)
    return float(np.nanmean(ious)) if not np.isnan(ious).all() else float("nan")


def interval(
    differences: NDArray[np.float64],
    seed: int = 0,
    draws: int = DRAWS,
    shared: bool = False,
) -> tuple[float, float] | None:
    """Interval of the mean of paired differences, by a bootstrap over places and, within each, over
    seeds.

    Places are drawn with replacement, then as many seeds of each as it has. The quantiles are those
    at which the interval of a mean has the right width for few places (``expanded_quantiles``).

    Args:
        differences: (P, S) of every place and seed; NaN where there is none.
        seed: of the draws.
        draws: their number.
        shared: whether the training of a seed is tested in all places; then each draw has the same
            seeds for all of them.

    Returns:
        Both ends; None with fewer than ``FEWEST_PLACES`` places.
    """
    there = [row[~np.isnan(row)] for row in differences]
    there = [row for row in there if len(row)]
    count = len(there)
    if count < FEWEST_PLACES:
        return None
    rng = np.random.default_rng(seed)
    means = np.empty((draws, count))
    order = np.arange(draws)
    if shared:
        seeds = rng.integers(0, differences.shape[1], (draws, differences.shape[1]))
    for place, values in enumerate(there):
        # The means of drawn seeds of this place, which are used whenever the place is drawn.
        if not shared:
            seeds = rng.integers(0, len(values), (draws, len(values)))
        means[:, place] = values[seeds % len(values)].mean(1)
    drawn = rng.integers(0, count, (draws, count))
    totals = np.zeros(draws)
    for column in range(count):
        if not shared:
            order = rng.permutation(draws)
        totals += means[order, drawn[:, column]]
    low, high = np.quantile(totals / count, expanded_quantiles(count))
    return float(low), float(high)


def expanded_quantiles(count: int) -> tuple[float, float]:
    """The quantiles of a bootstrap over ``count`` places between which its 95 % interval lies
    (Hesterberg, "What Teachers Should Know About the Bootstrap", 2015, section 5.4)."""
    tail = float(ndtr(-sqrt(count / (count - 1)) * stdtrit(count - 1, 0.975)))
    return tail, 1 - tail
