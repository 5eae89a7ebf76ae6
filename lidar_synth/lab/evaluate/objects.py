"""A judge of objects: can a small classifier tell the objects of generated scans from real ones?

Each object is cut out and described as its sensor sees it, without its box: turned so that the
sensor looks along x, its nearest side at 0. Every real object is compared with a generated one of
the same class, at about the same distance, and as wide as the sensor sees it, which for one class
tells the angle. The classifier never sees the place that it is asked about. Real objects of some
places against those of others tell what a perfect generator would get.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from lidar_synth.datasets.classes import LABELS
from lidar_synth.errors import DataError
from lidar_synth.geometry import Scan, Source
from lidar_synth.geometry.arrays import Float64Array
from lidar_synth.lab.evaluate.reading import readable
from lidar_synth.labels.objects import Object, instances_of, objects_of

CLASSES = {"car": LABELS["Car"], "person": LABELS["Pedestrian"]}
"""Train ids of the judged classes."""
LEAST = 20
"""Minimum number of returns of an object."""
NEAR = 0.15
"""Greatest difference of distance of two compared objects, as a share of it."""
WIDE = 0.4
"""Greatest difference of their seen widths, metres."""
FEWEST = 4
"""Objects of a place, real or generated, from which it has an AUC."""
HEIGHTS = np.linspace(0, 2.5, 11)
DEPTHS = np.array([-np.inf, 0.05, 0.1, 0.2, 0.4, 0.8, 1.6, np.inf])
ACROSS = 6
NEIGHBOURS = 8
TURNS = 4
"""Divisions of the real places into two parts, for the floor."""
GROUPS = ("height", "depth", "surfaces", "roughness", "returns")
"""Groups of features."""
RIDGE = 0.1
FARTHEST = 4
"""Standard deviations beyond which a feature counts as this."""


@dataclass(frozen=True)
class Crop:
    """One object as its sensor sees it.

    Args:
        place: of its scan.
        distance: from the sensor, metres.
        width: that the sensor sees, metres.
        returns: their number.
        roof, side: shares of the returns on surfaces that lie, and that stand.
        rough: median distance of a return from the plane of its neighbours, metres.
        features: {group: (D,) values} that the classifier gets.
    """

    place: str
    distance: float
    width: float
    returns: int
    roof: float
    side: float
    rough: float
    features: Mapping[str, Float64Array]


def crop(found: Object, place: str) -> Crop:
    """Describe an object."""
    points = found.scan.points.astype(np.float64)
    middle = np.median(points[:, :2], axis=0)
    distance = float(np.hypot(*middle))
    forward = middle / distance
    along = points[:, :2] @ forward
    across = points[:, :2] @ np.array([-forward[1], forward[0]])
    height = points[:, 2] - found.ground
    first, last = np.quantile(across, (0.02, 0.98))
    width = float(last - first)
    depth = along - np.quantile(along, 0.02)
    upright, off = _surfaces(points)
    count = len(points)
    heights = np.histogram(np.clip(height, 0, 2.49), HEIGHTS)[0] / count
    depths = np.histogram(depth, DEPTHS)[0] / count
    position = (across - first) / max(width, 1e-3) * ACROSS
    column = np.clip(position, 0, ACROSS - 1).astype(int)
    profile = [_median(depth[column == i]) for i in range(ACROSS)]
    roof = float(np.mean(upright > 0.8))
    side = float(np.mean(upright < 0.3))
    quantiles = np.log(np.quantile(off, (0.25, 0.5, 0.75, 0.9)) + 1e-3)
    top = np.quantile(height, (0.02, 0.5, 0.98))
    features = {
        "height": np.r_[heights, top],
        "depth": np.r_[depths, profile],
        "surfaces": np.array([roof, side]),
        "roughness": quantiles,
        "returns": np.array([np.log(count), np.log(distance), width]),
    }
    rough = float(np.median(off))
    return Crop(place, distance, width, count, roof, side, rough, features)


def _median(values: Float64Array) -> float:
    return float(np.median(values)) if len(values) else 0.0


def _surfaces(
    points: Float64Array,
) -> tuple[Float64Array, Float64Array]:
    """(N,) how upright the normal of the neighbours of each point is, 0 to 1; (N,) distance of the
    point from their plane, metres."""
    _, near = KDTree(points).query(points, min(NEIGHBOURS, len(points)))
    around = points[near] - points[near].mean(1, keepdims=True)
    _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))
    normal = axes[:, :, 0]
    off = np.abs(np.einsum("ni,ni->n", around[:, 0], normal))
    return np.abs(normal[:, 2]), off


def crops(scans: Source, name: str, placed: bool = True) -> list[Crop]:
    """The objects of a class in scans with boxes, or with labels and instances.

    Args:
        scans: their place is what stands before the last "/" of an id, or one for all without.
        name: of ``CLASSES``.
        placed: False for generated scans, which have no places.
    """
    found = []
    for scan in readable(scans):
        place = (scan.id.rpartition("/")[0] or ".") if placed else ""
        for one in _objects(scan):
            if _label(one) == CLASSES[name]:
                found.append(crop(one, place))
    return found


def _objects(scan: Scan) -> Iterable[Object]:
    if scan.boxes is None:
        return instances_of(scan, LEAST)
    return objects_of(scan, LEAST).values()


def _label(found: Object) -> int:
    """The class of most of its returns."""
    assert found.scan.label is not None
    return int(np.bincount(found.scan.label).argmax())


def match(real: Sequence[Crop], fake: Sequence[Crop]) -> list[tuple[Crop, Crop]]:
    """Pair each real object with the most similar generated one, each of them once.

    Args:
        real, fake: objects of one class; real ones without a similar one are left out.
    """
    if not real or not fake:
        return []
    own = KDTree(_seen(real))
    other = KDTree(_seen(fake))
    pairs = own.sparse_distance_matrix(other, 1.0, p=np.inf)
    rows = np.array([(d, i, j) for (i, j), d in pairs.items()]).reshape(-1, 3)
    used: tuple[set[int], set[int]] = (set(), set())
    matched = []
    for _, *ends in rows[np.lexsort(rows.T[::-1])].tolist():
        i, j = map(int, ends)
        if i not in used[0] and j not in used[1]:
            used[0].add(i)
            used[1].add(j)
            matched.append((real[i], fake[j]))
    return matched


def _seen(side: Sequence[Crop]) -> Float64Array:
    return np.array([(np.log(c.distance) / NEAR, c.width / WIDE) for c in side])


def separate(
    pairs: Sequence[tuple[Crop, Crop]], groups: Sequence[str] = GROUPS
) -> float | None:
    """The area under the ROC curve of a classifier that tells second objects from first ones: 0.5 =
    it cannot, 1 = it always can.

    Each place is left out in turn, that of the second objects too if they have one; the mean is
    weighted by the number of objects. None with fewer than two places of ``FEWEST`` objects.

    Args:
        pairs: as ``match`` makes them.
        groups: of features that the classifier gets.
    """
    areas = []
    weights = []
    for left_out in sorted({(real.place, fake.place) for real, fake in pairs}):
        tested = [p for p in pairs if (p[0].place, p[1].place) == left_out]
        hidden = {*left_out} - {""}
        trained = [p for p in pairs if not {p[0].place, p[1].place} & hidden]
        if min(len(tested), len(trained)) >= FEWEST:
            areas.append(_area(_rows(trained, groups), _rows(tested, groups)))
            weights.append(len(tested))
    return float(np.average(areas, weights=weights)) if areas else None


def _area(known: Float64Array, asked: Float64Array) -> float:
    """The area under the ROC curve at pairs (2 M, D) of a classifier that knows (2 N, D): ridge
    regression of the side on the features and their squares."""
    mean = known.mean(0)
    scale = known.std(0) + 1e-3
    inputs, given = (_with_squares((rows - mean) / scale) for rows in (known, asked))
    middle = inputs.mean(0)
    inputs -= middle
    ridge = RIDGE * len(inputs) * np.eye(inputs.shape[1])
    target = np.repeat([-1.0, 1.0], len(known) // 2)
    weights = np.linalg.solve(inputs.T @ inputs + ridge, inputs.T @ target)
    real, fake = ((given - middle) @ weights).reshape(2, -1)
    above = fake[:, None] - real[None]
    return float(((above > 0) + (above == 0) / 2).mean())


def _with_squares(rows: Float64Array) -> Float64Array:
    rows = np.clip(rows, -FARTHEST, FARTHEST)
    return np.concatenate([rows, rows**2], 1)


def _rows(pairs: Sequence[tuple[Crop, Crop]], groups: Sequence[str]) -> Float64Array:
    """(2 N, D) features of the first objects, then of the second ones."""
    crops = [pair[side].features for side in (0, 1) for pair in pairs]
    return np.array([np.concatenate([c[name] for name in groups]) for c in crops])


def find_floor(real: Sequence[Crop]) -> float | None:
    """What ``separate`` gives for the real objects of some places against those of others; mean
    over ``TURNS`` divisions of the places."""
    places = sorted({one.place for one in real})
    areas = []
    for seed in range(TURNS):
        order = np.random.default_rng(seed).permutation(len(places))
        half = {places[i] for i in order[::2]}
        one = [c for c in real if c.place in half]
        other = [c for c in real if c.place not in half]
        area = separate(match(one, other))
        areas += [] if area is None else [area]
    return float(np.mean(areas)) if areas else None


def _compare(own: Sequence[Crop], pairs: Sequence[tuple[Crop, Crop]]) -> dict[str, Any]:
    """The figures of one class."""
    sides = list(zip(*pairs, strict=True))
    return {
        "pairs": len(pairs),
        "places": len({one.place for one in sides[0]}),
        "auc": separate(pairs),
        "floor": find_floor(own),
        "by": {group: separate(pairs, [group]) for group in GROUPS},
        "returns": float(np.median([f.returns / r.returns for r, f in pairs])),
        "roof": [float(np.mean([c.roof for c in side])) for side in sides],
        "side": [float(np.mean([c.side for c in side])) for side in sides],
        "rough": [float(np.median([c.rough for c in side])) for side in sides],
    }


def compare_objects(real: Source, fake: Source) -> dict[str, Any]:
    """Judge the objects of generated scans by class; see the module.

    Args:
        real: scans with boxes, or with labels and instances, of at least two places.
        fake: generated scans, with boxes and instances.

    Returns:
        {class: figures}: ``pairs`` and ``places`` compared, ``auc`` and its ``floor`` in [0, 1], or
        None with too few objects; ``by``, the AUC by each group of features alone; ``returns``,
        median ratio of generated to real ones; the mean shares of returns on a ``roof`` and a
        ``side``, and the median roughness ``rough`` in metres, each [real, generated].

    Raises:
        DataError: without a pair of any class.
    """
    figures: dict[str, Any] = {}
    for name in CLASSES:
        own = crops(real, name)
        pairs = match(own, crops(fake, name, placed=False))
        if not pairs:
            continue
        figures[name] = _compare(own, pairs)
    if not figures:
        raise DataError(
            f"no two similar objects with {LEAST} returns in both sets",
            "scans with boxes, or with labels and instances",
        )
    return figures


def as_text(figures: Mapping[str, Any]) -> str:
    """The figures of ``compare_objects`` as a table in Markdown."""
    lines = [
        "| class | pairs | places | AUC | real against real | returns, fake / real | on a roof, % "
        "real | fake | on a side, % real | fake | roughness, mm real | fake | AUC by one group |",
        "|---|" + "---:|" * 11 + "---|",
    ]
    for kind, row in figures.items():
        areas = [row["auc"], row["floor"]]
        cells = ["" if area is None else f"{area:.2f}" for area in areas]
        cells.append(f"{row['returns']:.2f}")
        cells += [f"{100 * v:.0f}" for v in (*row["roof"], *row["side"])]
        cells += [f"{1000 * v:.0f}" for v in row["rough"]]
        alone = sorted((-(v or 0), name) for name, v in row["by"].items())
        cells.append(", ".join(f"{name} {-v:.2f}" for v, name in alone if v))
        lines.append(
            f"| {kind} | {row['pairs']} | {row['places']} | {' | '.join(cells)} |"
        )
    if any(row["auc"] is None for row in figures.values()):
        lines.append(f"\nAn AUC needs two places with {FEWEST} objects each.")
    return "\n".join(lines)
