"""What lies behind a removed object, estimated from the same rings beside it.

A ring is continued over the hole from both sides. If both are one surface, its horizontal distance
rho is interpolated: on the ground 1 / rho linearly in azimuth, else as on a plane wall, 1 / rho = a
cos(azimuth) + b sin(azimuth). Otherwise each side is continued to the middle. Deviations from it,
lost returns, reflectance and labels are copied from the rays beside the hole, mirrored at its edge.
Only ground can be where the object stood. An estimate just inside that place is moved to where the
ray leaves it. One farther inside is replaced by a copy of the next surface beside the hole that is
farther away; if there is none, there is no return.
"""

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from lidar_synth.geometry.arrays import Float64Array
from lidar_synth.labels.edit.rays import ScanRays

_compiled = numba.njit(cache=True)

SIDE = 32
"""Number of rays on each side of a hole from which its content is copied."""

REACH = 400
"""Number of rays beside a hole that are searched for the surface behind the object."""

FRONT = 0.5
"""Metres by which a return has to be nearer than the object to be in front of it, and not beside or
behind it."""

SAME = 0.2
"""Relative difference of distance below which both sides of a hole are one surface."""

WIDE = 1.5
"""Radians from which on a hole is too wide for a wall that only one of its sides shows."""

INSIDE = 0.5
"""Maximum depth inside the place of the object, metres, from which an estimate is moved to where
the ray leaves it."""

_BASE = 12  # rays between the two places that give the direction of a wall
_SMOOTH = 2  # rays to either side over which a distance is averaged


def continue_surfaces(
    rays: ScanRays,
    hole: NDArray[np.bool_],
    near: Float64Array,
    far: Float64Array,
    ground: NDArray[np.bool_],
    thing: NDArray[np.bool_],
) -> tuple[NDArray[np.int64], Float64Array]:
    """Continue the surfaces beside a hole.

    Args:
        rays: E rays.
        hole: (E,) True for rays of the hole.
        near: (E,) horizontal distance of the removed object at rays of the hole, metres.
        far: (E,) horizontal distance at which the ray leaves the place of the object, 0 = it does
            not pass through it.
        ground: (E,) True for returns of the ground, which may lie in front of the object.
        thing: (E,) True for returns of other objects, which do not continue behind it.

    Returns:
        (E,) the ray from which a ray of the hole is copied, -1 = none or not of the hole, and (E,)
        its horizontal distance in metres, inf = no return.
    """
    donor = np.full(len(hole), -1, np.int64)
    rho = np.full(len(hole), np.inf)
    known = (rays.point >= 0) & ~hole
    for first, stop in zip(
        rays.start[:-1].tolist(), rays.start[1:].tolist(), strict=True
    ):
        part = slice(first, stop)
        if hole[part].any() and not hole[part].all():
            ring = _Ring(
                rays.step,
                hole[part],
                known[part],
                rays.rho[part],
                near[part],
                far[part],
                ground[part],
                thing[part],
            )
            _fill(ring, donor[part], rho[part])
            donor[part] += first * (donor[part] >= 0)
    return donor, rho


class _Ring(NamedTuple):
    """Rays of one ring, the last of which is followed by the first, as of `continue_surfaces`."""

    step: float
    hole: NDArray[np.bool_]
    known: NDArray[np.bool_]
    rho: Float64Array
    near: Float64Array
    far: Float64Array
    ground: NDArray[np.bool_]
    thing: NDArray[np.bool_]


class _Side(NamedTuple):
    """Rays beside a hole, from its edge outwards.

    Attributes:
        rays: (S,) their numbers, at most `SIDE`.
        rho: median distance of the first returns, 0 = none.
        ground: whether the first return is one of the ground.
    """

    rays: NDArray[np.int64]
    rho: float
    ground: bool


@_compiled
def _fill(ring, donor, out):  # type: ignore[no-untyped-def]
    """Fill the holes of one ring."""
    count = len(ring.hole)
    for first in range(count):
        if ring.hole[first] and not ring.hole[first - 1]:
            length = 1
            while ring.hole[(first + length) % count]:
                length += 1
            _fill_hole(ring, first, length, donor, out)


@_compiled
def _fill_hole(ring, first, length, donor, out):  # type: ignore[no-untyped-def]
    """Fill the hole of some rays from the first on."""
    rays = (first + np.arange(length)) % len(ring.hole)
    limit = ring.near[rays].min()
    left = _side(ring, first - 1, -1, limit)
    right = _side(ring, first + length, 1, limit)
    # from the middle to the middle of the averaged rays
    turn = (length + 1 + 2 * _SMOOTH) * ring.step
    same = _one_surface(ring, left, right, turn)
    for k in range(length):
        share = (k + 1 + _SMOOTH) * ring.step / turn
        between = _between(left, right, turn, share) if same else 0.0
        ray = rays[k]
        of_left = len(left.rays) and (share < 0.5 or not len(right.rays))
        side, other = (left, right) if of_left else (right, left)
        if len(side.rays):
            nth = k if of_left else length - 1 - k
            donor[ray], out[ray] = _estimate(
                ring, side, other, nth, between, ring.far[ray]
            )


@_compiled
def _one_surface(ring, left, right, turn):  # type: ignore[no-untyped-def]
    """Whether both sides of a hole as wide as an angle show one surface."""
    a = left.rho
    b = right.rho
    if min(a, b) == 0 or (turn >= WIDE and left.ground != right.ground):
        return False
    return abs(a - b) < SAME * max(a, b) or (
        turn < WIDE
        and (
            abs(_ahead(ring, left, turn) - b) < SAME * b
            or abs(_ahead(ring, right, turn) - a) < SAME * a
        )
    )


@_compiled
def _between(left, right, turn, share):  # type: ignore[no-untyped-def]
    """Distance at a share of the way from the left to the right side of one surface."""
    of_left = 1 - share
    of_right = share
    if not (left.ground and right.ground) and turn < 3:
        of_left = np.sin((1 - share) * turn) / np.sin(turn)
        of_right = np.sin(share * turn) / np.sin(turn)
    return 1 / (of_left / left.rho + of_right / right.rho)


@_compiled
def _estimate(ring, side, other, nth, between, far):  # type: ignore[no-untyped-def]
    """The ray that the nth ray of a hole is copied from, and its distance, inf = no return.

    ``between`` is its distance on the surface that both sides show, 0 = they show none.
    """
    at = nth % len(side.rays)
    source = side.rays[at]
    if not ring.known[source]:
        return source, np.inf
    ground = ring.ground[source]
    # Ground that is continued towards a wall would rise.
    if between == 0 or (ground and side.ground != other.ground):
        between = side.rho
    around = min(at, len(side.rays) - 1 - at, _SMOOTH)
    smooth = _median(ring, side.rays[at - around : at + around + 1])
    # The source is of another surface than the edge.
    jump = abs(smooth - side.rho) > SAME * side.rho
    rho = ring.rho[source] if jump else between * ring.rho[source] / smooth
    if ground or rho >= far:
        return source, rho
    if rho > far - INSIDE:
        return source, far
    for rays in (side.rays, other.rays):
        for beyond in rays:
            if ring.known[beyond] and ring.rho[beyond] > far:
                return beyond, ring.rho[beyond]
    return source, np.inf


@_compiled
def _ahead(ring, side, turn):  # type: ignore[no-untyped-def]
    """Distance at the other edge of a plane wall through the returns of a side; inf = none."""
    if len(side.rays) < _BASE + 2 * _SMOOTH + 1:
        return np.inf
    far = _median(ring, side.rays[_BASE : _BASE + 2 * _SMOOTH + 1])
    if far == 0:
        return np.inf
    rise = (np.cos(_BASE * ring.step) / side.rho - 1 / far) / np.sin(_BASE * ring.step)
    inverse = np.cos(turn) / side.rho + np.sin(turn) * rise
    return 1 / inverse if inverse > 0 else np.inf


@_compiled
def _side(ring, start, step, limit):  # type: ignore[no-untyped-def]
    """Collect the rays beside a hole, from its edge outwards, but not those that end on or in front
    of an object."""
    rays = np.empty(SIDE, np.int64)
    found = 0
    count = len(ring.hole)
    for k in range(min(REACH, count)):
        i = (start + k * step) % count
        front = ring.known[i] and not ring.ground[i] and ring.rho[i] < limit - FRONT
        if not ring.hole[i] and not front and not ring.thing[i]:
            rays[found] = i
            found += 1
            if found == SIDE:
                break
    rays = rays[:found]
    returns = rays[ring.known[rays]]
    ground = len(returns) > 0 and ring.ground[returns[0]]
    return _Side(rays, _median(ring, returns[: 2 * _SMOOTH + 1]), ground)


@_compiled
def _median(ring, rays):  # type: ignore[no-untyped-def]
    """Median distance of the returns among rays; 0 = none."""
    values = ring.rho[rays[ring.known[rays]]]
    return np.median(values) if len(values) else 0.0
