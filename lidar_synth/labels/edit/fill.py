"""What lies behind a removed object, estimated from the same rings beside it.

A ring is continued over the hole from both sides. If both are one surface, its horizontal distance
rho is interpolated: on the ground 1 / rho linearly in azimuth, else as on a plane wall, 1 / rho = a
cos(azimuth) + b sin(azimuth). Otherwise each side is continued to the middle. Deviations from it,
lost returns, reflectance and labels are copied from the rays beside the hole, mirrored at its edge.
Nothing but ground can be where the object stood: an estimate just inside is moved to where the ray
leaves that place; in place of another, the next surface beside the hole that is farther away is
copied, and without one there is no return.
"""

import numba
import numpy as np
from numpy.typing import NDArray

from lidar_synth.labels.edit.rays import ScanRays

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
"""Metres by which an estimate may lie inside the place of the object to be moved to where the ray
leaves it."""

_BASE = 12  # rays between the two places that give the direction of a wall
_SMOOTH = 2  # rays to either side over which a distance is averaged


def continue_surfaces(
    rays: ScanRays,
    hole: NDArray[np.bool_],
    near: NDArray[np.float64],
    far: NDArray[np.float64],
    ground: NDArray[np.bool_],
    thing: NDArray[np.bool_],
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
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
            given = (
                hole[part],
                known[part],
                rays.rho[part],
                near[part],
                far[part],
                ground[part],
                thing[part],
            )
            _ring(rays.step, *given, donor[part], rho[part])
            donor[part] += first * (donor[part] >= 0)
    return donor, rho


@numba.njit(cache=True)
def _ring(  # type: ignore[no-untyped-def]
    step, hole, known, rho, near, far, ground, thing, donor, out
):
    """Fill the holes of one ring, whose last ray is followed by its first."""
    count = len(hole)
    left = np.empty(SIDE, np.int64)
    right = np.empty(SIDE, np.int64)
    for i in range(count):
        if not hole[i] or hole[i - 1]:
            continue
        length = 0
        limit = np.inf
        while hole[(i + length) % count]:
            limit = min(limit, near[(i + length) % count])
            length += 1
        n = _side(hole, known, rho, ground, thing, i - 1, -1, limit, left)
        m = _side(
            hole, known, rho, ground, thing, (i + length) % count, 1, limit, right
        )
        a = _edge(known, rho, left, n)
        b = _edge(known, rho, right, m)
        # from the middle to the middle of the averaged rays
        turn = (length + 1 + 2 * _SMOOTH) * step
        levels = _level(known, ground, left, n), _level(known, ground, right, m)
        flat = levels[0] and levels[1]
        mixed = levels[0] != levels[1]
        same = (
            min(a, b) > 0
            and abs(a - b) < SAME * max(a, b)
            and (turn < WIDE or not mixed)
        )
        if min(a, b) > 0 and not same and turn < WIDE:
            same = abs(_ahead(known, rho, left, n, step, turn) - b) < SAME * b
            same |= abs(_ahead(known, rho, right, m, step, turn) - a) < SAME * a
        for k in range(length):
            share = (k + 1 + _SMOOTH) * step / turn
            use_left = n > 0 and (m == 0 or share < 0.5)
            side, size, nth, edge = (
                (left, n, k, a) if use_left else (right, m, length - 1 - k, b)
            )
            if size == 0:
                continue
            source = side[nth % size]
            j = (i + k) % count
            donor[j] = source
            if not known[source]:
                continue
            base = edge
            # Ground that is continued towards a wall would rise.
            if same and not (mixed and ground[source]):
                of_a = 1 - share
                of_b = share
                if not flat and turn < 3:
                    of_a = np.sin((1 - share) * turn) / np.sin(turn)
                    of_b = np.sin(share * turn) / np.sin(turn)
                base = 1 / (of_a / a + of_b / b)
            at = nth % size
            around = min(at, size - 1 - at, _SMOOTH)
            smooth = _edge(known, rho, side[at - around : at + around + 1], -1)
            # The source is of another surface than the edge.
            jump = abs(smooth - edge) > SAME * edge
            out[j] = rho[source] if jump else base * rho[source] / smooth
            if not ground[source] and far[j] - INSIDE < out[j] < far[j]:
                out[j] = far[j]
            elif not ground[source] and out[j] < far[j]:
                beyond = _first_beyond(known, rho, side[:size], far[j])
                if beyond < 0:
                    beyond = _first_beyond(
                        known, rho, right[:m] if use_left else left[:n], far[j]
                    )
                donor[j] = beyond if beyond >= 0 else source
                out[j] = rho[beyond] if beyond >= 0 else np.inf


@numba.njit(cache=True)
def _first_beyond(known, rho, side, limit):  # type: ignore[no-untyped-def]
    """The first ray of a side whose return is farther away than a limit, metres; -1 = none."""
    for i in side:
        if known[i] and rho[i] > limit:
            return i
    return -1


@numba.njit(cache=True)
def _ahead(known, rho, side, size, step, turn):  # type: ignore[no-untyped-def]
    """Distance at the other edge of a plane wall through the returns of a side; inf = none."""
    if size < _BASE + 2 * _SMOOTH + 1:
        return np.inf
    near = _edge(known, rho, side, size)
    far = _edge(known, rho, side[_BASE : _BASE + 2 * _SMOOTH + 1], -1)
    if far == 0:
        return np.inf
    rise = (np.cos(_BASE * step) / near - 1 / far) / np.sin(_BASE * step)
    inverse = np.cos(turn) / near + np.sin(turn) * rise
    return 1 / inverse if inverse > 0 else np.inf


@numba.njit(cache=True)
def _side(hole, known, rho, ground, thing, start, step, limit, out):  # type: ignore[no-untyped-def]
    """Collect the rays beside a hole, from its edge outwards, but not those that end on or in front
    of an object."""
    found = 0
    count = len(hole)
    for k in range(min(REACH, count)):
        i = (start + k * step) % count
        front = known[i] and not ground[i] and rho[i] < limit - FRONT
        if not hole[i] and not front and not thing[i]:
            out[found] = i
            found += 1
            if found == SIDE:
                break
    return found


@numba.njit(cache=True)
def _edge(known, rho, side, size):  # type: ignore[no-untyped-def]
    """Median distance of the first returns on a side, or with size -1 of all of them; 0 = none."""
    values = np.empty(len(side))
    found = 0
    for i in side if size < 0 else side[:size]:
        if known[i]:
            values[found] = rho[i]
            found += 1
            if size >= 0 and found == 2 * _SMOOTH + 1:
                break
    return np.median(values[:found]) if found else 0.0


@numba.njit(cache=True)
def _level(known, ground, side, size):  # type: ignore[no-untyped-def]
    """Whether the first return on a side is one of the ground."""
    for i in side[:size]:
        if known[i]:
            return ground[i]
    return False
