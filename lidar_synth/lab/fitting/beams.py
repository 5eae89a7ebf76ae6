"""From points to beams, by their rings or by peaks of the elevations."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lidar_synth.geometry import Scan
from lidar_synth.geometry.arrays import Float64Array
from lidar_synth.geometry.lines import nearest_beams, residuals
from lidar_synth.lab.fitting.model import CAP, Cloud, Model, refine
from lidar_synth.lab.fitting.peaks import beam_peaks
from lidar_synth.lab.fitting.points import gather, rings_of_file
from lidar_synth.lab.fitting.search import REACH, find_motion, find_mount

log = logging.getLogger(__name__)


POINTS = 120_000
"""Number of points that a fit uses; a choice between models uses a third of them."""

NEAREST = 0.5
"""Points nearer than this to the vertical axis are left out of the fit, metres."""

WIDTHS = np.radians([0.02, 0.01, 0.04, 0.08])
"""Smoothing widths that are tried to find the peaks."""

GAIN = {"motion": 0.9, "mount": 0.9, "heights": 0.75}
"""A part of the model is kept if it reduces the mean residual to less than this share."""

GOOD = 0.9
"""Quality above which no other mounting is looked for."""

DOUBLE = np.radians(0.02)
"""Two beams nearer than this are one."""

POOR = 0.6
"""Quality below which the mounting is not known well enough to look for the start of the turn."""

SETTLING = 8
"""Largest number of times that the steps of the last fit are repeated while they raise the
quality."""

GOOD_ENOUGH = 0.995
"""Quality above which they are not."""

ROUNDS = 3
"""Number of times that peaks are looked for, each time with what is known of mounting and
motion."""


@dataclass(frozen=True)
class Beams:
    """Fitted beams with what they rest on.

    Args:
        model: beams, mounting and motion.
        source: where the rings come from: "ring field", "order of the points" or "elevations".
        parts: the parts of the model besides the elevations, of ``GAIN``.
    """

    model: Model
    source: str
    parts: frozenset[str]


def fit_beams(scans: Sequence[Scan]) -> tuple[Beams | None, Cloud]:
    """Fit beams, mounting and motion to scans.

    Args:
        scans: of one sensor.

    Returns:
        The beams, None if there are fewer than two; and all points with their rings of the file, if
        there are any.

    Raises:
        DataError: without points, or with points that are not finite.
    """
    cloud = gather(scans)
    source, ring = rings_of_file(scans)
    cloud = replace(
        cloud, ring=cloud.ring if ring is None else ring, kept=ring is not None
    )
    part = _without_gaps(_some_points(cloud, POINTS))
    still = Model(
        np.zeros(1), np.zeros(1), np.zeros(3), np.eye(3), np.zeros((len(scans), 6))
    )
    best, quality = _attempt(part, still)
    if quality < GOOD:
        log.warning(
            "the points show no sharp beams from their origin: the sensor's place is "
            "searched, which takes minutes"
        )
        offset, turn = find_mount(
            [cloud.points[cloud.scan == scan] for scan in range(len(scans))]
        )
        moved, better = _attempt(
            part, replace(still, offset=offset, turn=turn), frozenset({"mount"})
        )
        if better > quality:
            best = moved
            quality = better
    if (
        POOR < quality < GOOD
        and best
        and not cloud.kept
        and not any(scan.time is not None for scan in scans)
    ):
        best = _with_another_seam(part, best, quality)
    return (Beams(best[0], source, best[1]) if best else None), cloud


def _with_another_seam(
    cloud: Cloud, best: tuple[Model, frozenset[str]], quality: float
) -> tuple[Model, frozenset[str]]:
    """The best fit with turns that start behind the sensor, as before, or on another side of it."""
    still = replace(
        best[0],
        motion=np.zeros_like(best[0].motion),
        tangents=np.zeros(1),
        heights=np.zeros(1),
    )
    for seam in (0.25, 0.5, 0.75):
        turned = replace(cloud, time=(cloud.time + seam + 0.5) % 1.0 - 0.5)
        other, better = _attempt(turned, still, frozenset({"motion", "mount"}))
        if other and better > quality:
            best = other
            quality = better
    return best


def _some_points(cloud: Cloud, count: int) -> Cloud:
    use = np.flatnonzero(np.hypot(cloud.points[:, 0], cloud.points[:, 1]) > NEAREST)
    if cloud.kept:
        use = use[cloud.ring[use] >= 0]
    if len(use) > count:
        use = np.sort(np.random.default_rng(0).choice(use, count, replace=False))
    return Cloud(
        cloud.points[use], cloud.scan[use], cloud.time[use], cloud.ring[use], cloud.kept
    )


def _without_gaps(cloud: Cloud) -> Cloud:
    """The cloud with rings of the file numbered 0, 1, ...: files may count from 1, and lasers may
    be dead."""
    if cloud.kept:
        return replace(cloud, ring=np.unique(cloud.ring, return_inverse=True)[1])
    return cloud


def _grow(
    cloud: Cloud, model: Model, parts: frozenset[str]
) -> tuple[Model, frozenset[str]]:
    """The model with the parts that fit it, and with the beams that are peaks once it has them."""
    few = _some_points(cloud, POINTS // 3)
    for _ in range(1 if cloud.kept else ROUNDS):
        model, parts = _choose_parts(few, model, parts)
        again = None if cloud.kept else add_peaks(cloud, model)
        if again is None or len(again.tangents) == len(model.tangents):
            break
        model = again
    return model, parts


def _attempt(
    cloud: Cloud, still: Model, parts: frozenset[str] = frozenset()
) -> tuple[tuple[Model, frozenset[str]] | None, float]:
    """The best model from one mounting, its parts, and its quality."""
    model = _from_rings(cloud, still) if cloud.kept else add_peaks(cloud, still)
    if model is None:
        return None, 0.0
    model, parts = _grow(cloud, model, parts)
    if "motion" in parts:
        model = _with_motion(cloud, model)
    quality = 0.0
    for _ in range(SETTLING):
        model, fitted = refine(cloud, model, parts, 4)
        before = quality
        quality = quality_of(model, fitted)
        if quality > GOOD_ENOUGH or quality - before < 0.001:
            break
    model = _without_doubles(model, fitted)
    inside = bool((np.abs(model.offset) < np.array(REACH) + 0.5).all())
    return (model, parts), quality if inside else 0.0


def _without_doubles(model: Model, cloud: Cloud) -> Model:
    """The model without beams that have met a stronger one on the same line."""
    if cloud.kept:
        return model
    points = np.bincount(cloud.ring, minlength=len(model.tangents))
    order = np.argsort(-model.tangents)
    kept: list[int] = []
    for beam in order.tolist():
        if (
            kept
            and np.arctan(model.tangents[kept[-1]]) - np.arctan(model.tangents[beam])
            < DOUBLE
        ):
            kept[-1] = max(kept[-1], beam, key=lambda one: int(points[one]))
        else:
            kept.append(beam)
    return replace(model, tangents=model.tangents[kept], heights=model.heights[kept])


def quality_of(model: Model, cloud: Cloud) -> float:
    """Share of points in the middle half between the borders of their beams; 0.5 for points
    anywhere."""
    residual = residuals(
        model.aligned(cloud), cloud.ring, model.tangents, model.heights
    )
    return float((np.abs(residual) < room_of(model.tangents)[cloud.ring] / 4).mean())


def room_of(tangents: Float64Array) -> Float64Array:
    """(B,) angle from each beam to the next one, the nearer of the two, radians."""
    order = np.argsort(tangents)
    gap = np.diff(np.arctan(tangents[order]))
    room = np.empty(len(tangents))
    room[order] = np.minimum(np.r_[gap, gap[-1]], np.r_[gap[0], gap])
    return room


def _choose_parts(
    cloud: Cloud, model: Model, parts: frozenset[str]
) -> tuple[Model, frozenset[str]]:
    """Add the part that reduces the residuals most, as long as one does so clearly."""
    model, fitted = refine(cloud, model, parts, 5)
    now = _score(model, fitted)
    while others := [part for part in GAIN if part not in parts]:
        trials = {
            part: refine(
                cloud,
                _with_motion(cloud, model) if part == "motion" else model,
                parts | {part},
                8,
            )
            for part in others
        }
        scores = {part: _score(*trial) for part, trial in trials.items()}
        part = min(scores, key=lambda name: scores[name] / GAIN[name])
        if scores[part] >= GAIN[part] * now:
            break
        model, _ = trials[part]
        parts = parts | {part}
        now = scores[part]
    return model, parts


def _with_motion(cloud: Cloud, model: Model) -> Model:
    """The model with a new first guess of the motion of scans whose points lie off the beams."""
    ring = (
        cloud.ring
        if cloud.kept
        else nearest_beams(model.aligned(cloud), model.tangents, model.heights)
    )
    motion = model.motion.copy()
    for scan in np.unique(cloud.scan):
        use = cloud.scan == scan
        part = Cloud(
            cloud.points[use], cloud.scan[use], cloud.time[use], ring[use], cloud.kept
        )
        if quality_of(model, part) < GOOD:
            motion[scan] = find_motion(part, model, scan)
    return replace(model, motion=motion)


def _score(model: Model, cloud: Cloud) -> float:
    """The mean residual, capped, radians."""
    residual = residuals(
        model.aligned(cloud), cloud.ring, model.tangents, model.heights
    )
    return float(np.minimum(np.abs(residual), CAP).mean())


def _from_rings(cloud: Cloud, still: Model) -> Model | None:
    """A model with the median elevation of each ring; None without two rings."""
    points = still.aligned(cloud)
    order = np.argsort(cloud.ring, kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(cloud.ring[order])) + 1)
    if len(parts) < 2:
        return None
    tangents = np.zeros(int(cloud.ring.max()) + 1)
    for part in parts:
        tangents[cloud.ring[part[0]]] = np.median(
            points[part, 2] / np.hypot(points[part, 0], points[part, 1])
        )
    return replace(still, tangents=tangents, heights=np.zeros(len(tangents)))


def add_peaks(cloud: Cloud, model: Model) -> Model | None:
    """The model with its beams found anew, as peaks of the elevations; None without two beams."""
    points = model.aligned(cloud)
    ring = nearest_beams(points, model.tangents, model.heights)
    elevation = np.arctan2(
        points[:, 2] - model.heights[ring], np.hypot(points[:, 0], points[:, 1])
    )
    found = [beam_peaks(elevation, width) for width in WIDTHS]
    best = max(found, key=lambda beams: concentration(elevation, beams))
    if len(best) < 2:
        return None
    nearest = np.abs(np.arctan(model.tangents)[None] - best[:, None]).argmin(1)
    return replace(model, tangents=np.tan(best), heights=model.heights[nearest])


def concentration(elevation: Float64Array, beams: Float64Array) -> float:
    """Share of points in the middle half between the borders of their beams, 0.5 for points
    anywhere; 0 for no beams.

    Args:
        elevation: (N,) radians.
        beams: (B,) radians, highest first.
    """
    if len(beams) < 2:
        return 0.0
    up = np.sort(beams)
    border = (up[1:] + up[:-1]) / 2
    ring = np.searchsorted(border, elevation)
    gap = np.diff(up)
    room = np.minimum(np.r_[gap, gap[-1]], np.r_[gap[0], gap])[ring]
    distance = np.abs(elevation - up[ring])
    near = distance < room / 2
    return float((distance[near] < room[near] / 4).sum() / max(len(distance), 1))
