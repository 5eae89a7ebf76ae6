"""What the columns and classes of samples mean: statistics of real and synthetic ones, and how they
contradict.

Two samples may have the same keys, types and shapes and still mean different things: centimetres,
another axis, another numbering of classes. Their distributions show this. The limits of what is
refused are far larger than the differences among the public datasets, the town and the shipped
models (docs/how-to/mix.md).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import SEMANTIC_KITTI
from lidar_synth.geometry import Scan
from lidar_synth.geometry.arrays import Float64Array
from lidar_synth.geometry.projection import project

LOOKED_AT = 15_000
"""Approximate number of rows of a sample that are measured."""

QUANTILES = (0.01, 0.5, 0.99)

NAMES_OF_COLUMNS = ("x", "y", "z", "reflectance")

VARIED = 8
"""Number of different values from which on a column counts as varied."""

OTHER_UNIT = 6.0
UNUSUAL_UNIT = 3.0
"""Ratios of median ranges: refused, and reported. Sensors are up to 2.8 apart, feet 3.3,
centimetres 100."""

OTHER_SIZE = 1.5
"""Ratio of numbers of points that is reported."""

OTHER_SCALE = 10.0
"""Ratio of the spread of a column that is refused."""

OTHER_GROUND = 1.0
UNUSUAL_GROUND = 0.5
"""Differences in metres between the heights of the ground, refused and reported: KITTI's is -1.7,
PandaSet's -2.2."""

TURNED = 0.15
SURE = 2.5
"""For roads to have a direction: minimum mean elongation along an axis (logarithm), and its minimum
ratio to its standard error."""

OTHER_SHARES = 0.5
"""Total variation distance between the shares of the classes; that of streets and motorways is up
to 0.4."""

EXPLAINED = 0.7
"""A renumbering of the classes explains that distance if it leaves less than this share of it."""

LARGE = 0.03
"""Share of a class that is large enough to be recognised."""

ALIKE = 1.0
UNLIKE = 1.6
"""Costs of a match of two classes (``_cost``) below which they look alike, and above which they do
not."""


class Table(NamedTuple):
    """Points of a sample.

    Args:
        columns: (N, C) values by column; those of points begin with x, y, z in metres.
        label: (N,) integers, or None.
        spatial: whether the first three columns are x, y, z.
    """

    columns: Float64Array
    label: NDArray[np.int64] | None
    spatial: bool


class Contradiction(NamedTuple):
    """A contradiction in words, and whether it is certainly an error."""

    text: str
    certain: bool


@dataclass(frozen=True)
class ClassLook:
    """A class: share of the labelled points, median height above the ground and median range in
    metres."""

    share: float
    height: float
    range: float


@dataclass(frozen=True)
class Meaning:
    """The statistics of several samples.

    Args:
        points: median number of rows.
        quantiles: (C, 3) quantiles of each column.
        constant, varied: (C,) whether a column has one value, and whether it has more than
            ``VARIED``.
        distance: median range in metres; NaN without coordinates.
        ground, ceiling: median height of the lowest points, and of the highest ones, of small
            areas; NaN if unknown.
        along: for each sample, how much farther it reaches in x than in y (logarithm).
        classes: {label: its look}.
    """

    points: float
    quantiles: Float64Array
    constant: NDArray[np.bool_]
    varied: NDArray[np.bool_]
    distance: float
    ground: float
    ceiling: float
    along: tuple[float, ...]
    classes: dict[int, ClassLook]


def table_of(scan: Scan) -> Table:
    """The points of a scan with reflectance and labels."""
    columns = np.column_stack([scan.points, scan.reflectance]).astype(np.float64)
    return Table(
        columns, None if scan.label is None else scan.label.astype(np.int64), True
    )


def rows_in_use(scans: Sequence[Scan]) -> int:
    """The median number of rows of a scan's range image with returns in at least 2 % of their
    columns."""
    filled = [(project(scan).range > 0).mean(1) >= 0.02 for scan in scans]
    return int(np.median([rows.sum() for rows in filled]))


def measure_tables(tables: Sequence[Table], ignored: Sequence[int]) -> Meaning:
    """Measure samples of one kind.

    Args:
        tables: at least one, with the same number of columns.
        ignored: labels that are no class.
    """
    thin = [_thinned(table) for table in tables]
    columns = np.concatenate([table.columns for table in thin])
    numbers = np.array(
        [
            len(np.unique(column[:: max(1, len(columns) // 4000)]))
            for column in columns.T
        ]
    )
    spatial = tables[0].spatial
    grounds = [_floor_height(table.columns) for table in thin] if spatial else []
    ceilings = [
        -_floor_height(table.columns * [1, 1, -1, *[1] * (columns.shape[1] - 3)])
        for table in thin
        if spatial
    ]
    ground = _median(grounds)
    distance = height = np.full(len(columns), np.nan)
    if spatial:
        distance = np.linalg.norm(columns[:, :3], axis=1)
        height = columns[:, 2] - np.nan_to_num(ground)
    return Meaning(
        points=float(np.median([len(table.columns) for table in tables])),
        quantiles=np.quantile(columns, QUANTILES, axis=0).T,
        constant=numbers == 1,
        varied=numbers > VARIED,
        distance=_median(distance),
        ground=ground,
        ceiling=_median(ceilings),
        along=tuple(_elongation(table.columns) for table in thin if spatial),
        classes=_measure_classes(thin, height, distance, ignored),
    )


def _thinned(table: Table) -> Table:
    """About ``LOOKED_AT`` rows of a table, evenly spread."""
    step = max(1, len(table.columns) // LOOKED_AT)
    label = None if table.label is None else table.label[::step]
    return Table(table.columns[::step], label, table.spatial)


def _median(values: Sequence[float] | Float64Array) -> float:
    known = np.asarray(values, np.float64)
    known = known[np.isfinite(known)]
    return float(np.median(known)) if len(known) else float("nan")


def _floor_height(points: Float64Array) -> float:
    """The median over squares of 2 m, 3 to 25 m away, of the height of their lowest points; NaN if
    there are few."""
    away = np.hypot(points[:, 0], points[:, 1])
    near = points[(away > 3) & (away < 25)]
    square = (np.floor(near[:, 0] / 2) * 1000 + np.floor(near[:, 1] / 2)).astype(
        np.int64
    )
    order = np.lexsort((near[:, 2], square))
    _, start, count = np.unique(square[order], return_index=True, return_counts=True)
    lowest = near[order, 2][start + count // 20]
    lowest = lowest[count >= 5]
    return float(np.median(lowest)) if len(lowest) >= 20 else float("nan")


def _elongation(points: Float64Array) -> float:
    """The logarithm of how much farther the points reach in x than in y: above 0 on most roads,
    which run along x."""
    reach = np.quantile(np.abs(points[:, :2]), 0.95, axis=0)
    return float(np.log(max(reach[0], 0.01) / max(reach[1], 0.01)))


def _measure_classes(
    tables: Sequence[Table],
    height: Float64Array,
    distance: Float64Array,
    ignored: Sequence[int],
) -> dict[int, ClassLook]:
    labels = [
        np.full(len(t.columns), ignored[0]) if t.label is None else t.label
        for t in tables
    ]
    label = np.concatenate(labels)
    valid = ~np.isin(label, list(ignored))
    found = {}
    for value in np.unique(label[valid]).tolist():
        here = label == value
        share = float(here.sum() / valid.sum())
        found[value] = ClassLook(share, _median(height[here]), _median(distance[here]))
    return found


def contradictions(
    real: Meaning, synthetic: Meaning, place: str = ""
) -> Iterator[Contradiction]:
    """Describe how the statistics of synthetic samples contradict those of real ones.

    Args:
        real, synthetic: of arrays with the same columns.
        place: the arrays' name within a sample.
    """
    coordinates = 0 if np.isnan(real.distance) else 3
    unit = list(_unit(real, synthetic))
    named = f"{place}: " if place else ""
    size = max(real.points, synthetic.points) / min(real.points, synthetic.points)
    if coordinates and size > OTHER_SIZE:
        text = (
            f"{named}{synthetic.points:,.0f} points instead of {real.points:,.0f}: density tells "
            "them apart"
        )
        yield Contradiction(text, False)
    geometry = unit or [*_heights(real, synthetic), *_axes(real, synthetic)]
    for found in [
        *geometry,
        *_columns(real, synthetic, coordinates),
        *_classes(real, synthetic),
    ]:
        yield Contradiction(named + found.text, found.certain)


def _unit(real: Meaning, synthetic: Meaning) -> Iterator[Contradiction]:
    ratio = synthetic.distance / max(real.distance, 1e-9)
    factor = max(ratio, 1 / max(ratio, 1e-9))
    if factor > UNUSUAL_UNIT:
        text = (
            f"the median distance of points is {synthetic.distance:.4g} instead of "
            f"{real.distance:.4g}: coordinates in another unit, such as centimetres"
        )
        yield Contradiction(text, factor > OTHER_UNIT)


def _heights(real: Meaning, synthetic: Meaning) -> Iterator[Contradiction]:
    offset = abs(synthetic.ground - real.ground)
    if not offset > UNUSUAL_GROUND:  # also if unknown
        return
    text = (
        f"the ground is at z = {synthetic.ground:.2f} m instead of {real.ground:.2f} m"
    )
    if abs(-synthetic.ceiling - real.ground) < UNUSUAL_GROUND < offset:
        text += ": z points down in one of them"
    else:
        text += ": the origin is at another height, such as on the ground"
    yield Contradiction(text, offset > OTHER_GROUND)


def _axes(real: Meaning, synthetic: Meaning) -> Iterator[Contradiction]:
    ours = _direction(synthetic.along)
    theirs = _direction(real.along)
    if ours * theirs < 0:
        text = (
            f"roads run along {'x' if ours > 0 else 'y'} instead of {'x' if theirs > 0 else 'y'}: "
            "other axes, such as nuScenes' x to the right and y forward"
        )
        yield Contradiction(text, True)


def _direction(along: Sequence[float]) -> int:
    """1 if several samples are clearly elongated along x, -1 along y, 0 if neither is sure."""
    if len(along) < 4:
        return 0
    mean = float(np.mean(along))
    error = float(np.std(along, ddof=1)) / len(along) ** 0.5
    return int(np.sign(mean)) if abs(mean) > max(TURNED, SURE * error) else 0


def _columns(
    real: Meaning, synthetic: Meaning, coordinates: int
) -> Iterator[Contradiction]:
    """Describe columns with another scale, or with one value only; coordinates are left to
    ``_unit`` and ``_heights``."""
    for number in range(coordinates, len(real.quantiles)):
        name = (
            NAMES_OF_COLUMNS[number]
            if coordinates and number < 4
            else f"column {number}"
        )
        low, high = synthetic.quantiles[number, [0, 2]]
        ranges = (
            f"{low:.4g} to {high:.4g} instead of {real.quantiles[number, 0]:.4g} to "
            f"{real.quantiles[number, 2]:.4g}"
        )
        spread = high - low
        expected = np.ptp(real.quantiles[number])
        if synthetic.constant[number] and real.varied[number]:
            yield Contradiction(f"{name} is always {low:.4g}, {ranges}", number < 4)
        elif real.constant[number] and synthetic.varied[number]:
            yield Contradiction(f"real {name} is always the same: {ranges}", number < 4)
        elif (
            min(spread, expected) > 0
            and max(spread / expected, expected / spread) > OTHER_SCALE
        ):
            yield Contradiction(
                f"{name} is {ranges} (1st to 99th percentile): another scale", True
            )


def _classes(real: Meaning, synthetic: Meaning) -> Iterator[Contradiction]:
    ours = synthetic.classes
    theirs = real.classes
    if not ours or not theirs:
        return
    distance = _distance(ours, theirs)
    if distance <= OTHER_SHARES:
        return
    remaining = {}  # by the distance that each renumbering leaves
    for reason, numbers in _renumberings():
        renumbered = {numbers.get(value, -1): look for value, look in ours.items()}
        remaining[_distance(renumbered, theirs)] = reason, numbers
    explained = min(remaining) < EXPLAINED * distance
    pairs = dict(_matches(theirs, ours))
    if explained:
        reason, numbers = remaining[min(remaining)]
        known = sorted(ours.keys() & numbers, key=lambda value: -ours[value].share)
        pairs = {value: numbers[value] for value in known}
    text = "; ".join(
        f"class {value} looks like your {other}"
        for value, other in [*pairs.items()][:4]
    )
    if explained:
        yield Contradiction(f"{text}: {reason}", True)
        return
    unseen = sum(look.share for value, look in ours.items() if value not in theirs)
    moved = sum(ours[value].share for value in pairs)
    if not pairs and unseen > OTHER_SHARES:
        missing = sorted(set(ours) - set(theirs))[:4]
        text = f"classes {missing}, {unseen:.0%} of the points, are in no real sample"
    text = text or f"classes differ for {distance:.0%} of the points"
    yield Contradiction(text, moved > 0.4 or unseen > OTHER_SHARES)


def _renumberings() -> Iterator[tuple[str, dict[int, int]]]:
    """Usual mistakes: a reason and {synthetic class: real class}."""
    for step in (1, -1):
        yield (
            "the numbers of the classes are off by one",
            {value: value - step for value in range(256)},
        )
    raw = dict(enumerate(SEMANTIC_KITTI.from_train or ()))
    reason = "SemanticKITTI's ids in files beside its 19 train ids"
    yield reason, {value: train for train, value in raw.items()}
    yield reason, raw


def _distance(ours: dict[int, ClassLook], theirs: dict[int, ClassLook]) -> float:
    """The total variation distance between the shares of classes, 0 to 1."""
    values = ours.keys() | theirs.keys()
    share = [
        [look[v].share if v in look else 0.0 for look in (ours, theirs)] for v in values
    ]
    return sum(abs(one - other) for one, other in share) / 2


def _matches(
    real: dict[int, ClassLook], synthetic: dict[int, ClassLook]
) -> Iterator[tuple[int, int]]:
    """(synthetic class, real class) of large classes that look like another real class and unlike
    their own."""
    large = {value: look for value, look in real.items() if look.share > LARGE}
    for value, look in sorted(synthetic.items(), key=lambda pair: -pair[1].share):
        if look.share > LARGE and large:
            own = _cost(look, real[value]) if value in real else float("inf")
            other = min(large, key=lambda v: _cost(look, large[v]))
            if other != value and own > UNLIKE and _cost(look, large[other]) < ALIKE:
                yield value, other


def _cost(one: ClassLook, other: ClassLook) -> float:
    """How unlike two classes look: by height, share and range."""
    height = abs(one.height - other.height) / 0.7
    parts = [
        height,
        abs(np.log(one.share / other.share)) / 1.2,
        abs(np.log(one.range / other.range)) / 0.7,
    ]
    return float(np.nansum(parts))
