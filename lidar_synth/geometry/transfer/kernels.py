"""Compiled kernels: triangles between neighbouring returns, and the first hits of a sensor's rays on them.

Triangles join neighbouring rings like a zip. Rays of one laser form a cone z = height + slope * rho around the axis,
rho = hypot(x, y). A triangle is cut by the cone in a segment, and the segment is cut by the firings whose azimuth lies
between its ends. So each triangle visits only the rays that hit it.
"""

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

SAME_RING, SAME_OBJECT, OTHER_OBJECT = np.tan(np.radians(4.0)), np.tan(np.radians(8.0)), np.tan(np.radians(25.0))
"""Smallest angle between a ray and the line from its return to the neighbouring return, for which both are of one
surface (Bogoslavskyi and Stachniss, "Fast range image-based segmentation", IROS 2016): along a ring, between rings,
and between returns with different labels or instances."""

NOISE = 0.06
"""Metres; neighbours whose ranges differ by less are of one surface."""

WIDEST = 1.6
"""The widest gap between neighbours of one ring, in firings; a wider one is a ray without a return."""

_UNKNOWN = -1

NEAREST, FARTHEST = 0.6, 1.6
"""How far a footprint extends along grazing rays, as a factor of the distance of its return."""

WIDEST_FOOTPRINT = 0.2
"""Radians to either side of its return by which a footprint extends at most."""


class Vertices(NamedTuple):
    """N returns in the target's frame.

    Args:
        points: (N, 3) metres.
        azimuth: (N,) radians, clockwise.
        rho: (N,) horizontal distance, metres.
        rows: (N,) of ``rows_above``.
        value: (N,) is interpolated between them.
    """

    points: NDArray[np.float64]
    azimuth: NDArray[np.float64]
    rho: NDArray[np.float64]
    rows: NDArray[np.int32]
    value: NDArray[np.float32]


class FootprintShape(NamedTuple):
    """The shape of the footprints of N returns.

    Args:
        recorded: (N, 3) metres, in the frame of the sensor that recorded the returns.
        level: (N,) returns of level surfaces; the footprints of others are vertical and face the target.
        half: width to either side, metres per metre of distance.
        up, down: (N,) height above and below the return, metres per metre of distance.
    """

    recorded: NDArray[np.float32]
    level: NDArray[np.bool_]
    half: float
    up: NDArray[np.float64]
    down: NDArray[np.float64]


class Nearest(NamedTuple):
    """The nearest hit of each ray.

    Args:
        rho: (H, F) horizontal distance, metres; inf = none.
        vertex: (H, F) the nearest of the returns that form the surface.
        value: (H, F) interpolated between them.
        facing: (H, F) cosine of the angle between the ray and the normal.
    """

    rho: NDArray[np.float64]
    vertex: NDArray[np.int32]
    value: NDArray[np.float32]
    facing: NDArray[np.float32]


@numba.njit(cache=True, nogil=True)
def neighbours_below(starts, azimuth, step, bridge, below):  # type: ignore[no-untyped-def]
    """Fill ``below`` (N,) with the nearest return of the next ring within one step of azimuth; -1 = none.

    With ``bridge``, a return without one looks in the ring after the next.
    """
    below[:] = -1
    rings = len(starts) - 1
    for k in range(rings - 1):
        for further in range(1, 3 if bridge else 2):
            if k + further >= rings:
                break
            low, high = starts[k + further], starts[k + further + 1]
            j = low
            for i in range(starts[k], starts[k + 1]):
                while j + 1 < high and abs(azimuth[j + 1] - azimuth[i]) <= abs(azimuth[j] - azimuth[i]):
                    j += 1
                if below[i] < 0 and j < high and abs(azimuth[j] - azimuth[i]) <= step:
                    below[i] = j


@numba.njit(cache=True, nogil=True)
def find_level(points, below, level):  # type: ignore[no-untyped-def]
    """Mark in ``level`` (N,) the returns of nearly level surfaces, such as the road, by their neighbour below."""
    level[:] = False
    for i in range(len(points)):
        j = below[i]
        if j >= 0:
            xi, yi, zi = _exactly(points, i)
            xj, yj, zj = _exactly(points, j)
            along = np.sqrt((xi - xj) ** 2 + (yi - yj) ** 2)
            if abs(zi - zj) <= 0.12 * along + 0.02 and along > 0.05:
                level[i] = True
    for i in range(len(points)):  # the nearest returns of a surface have no neighbour below
        j = below[i]
        if j >= 0 and level[i] and below[j] < 0:
            level[j] = True


@numba.njit(cache=True, nogil=True, inline="always")
def _exactly(points, i):  # type: ignore[no-untyped-def]
    """The coordinates of a float32 point in float64, which differences of near points need."""
    return np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])


@numba.njit(cache=True, nogil=True, inline="always")
def _joined(points, distance, key, ground, level, i, j, across):  # type: ignore[no-untyped-def]
    """1 if two neighbouring returns are of one surface, else 0."""
    if abs(distance[i] - distance[j]) < NOISE:
        return 1
    xi, yi, zi = _exactly(points, i)
    xj, yj, zj = _exactly(points, j)
    far = max(xi * xi + yi * yi + zi * zi, xj * xj + yj * yj + zj * zj)
    same = key[i] == key[j]
    if across and (same or (ground[i] and ground[j])) and level[i] and level[j]:
        return int(abs(zi - zj) < 0.1 + 0.03 * np.sqrt((xi - xj) ** 2 + (yi - yj) ** 2))
    cx, cy, cz = yi * zj - zi * yj, zi * xj - xi * zj, xi * yj - yi * xj
    least = OTHER_OBJECT if not same else SAME_OBJECT if across else SAME_RING
    return int(np.sqrt(cx * cx + cy * cy + cz * cz) >= least * (far - (xi * xj + yi * yj + zi * zj)))


@numba.njit(cache=True, nogil=True, inline="always")
def _around(azimuth, start, i, count):  # type: ignore[no-untyped-def]
    """Return ``i`` of a ring that begins at ``start``, which may be past its end, and its azimuth, radians."""
    if i < count:
        return start + i, azimuth[start + i]
    i = start + (i - count if i < 2 * count else i % count)
    return i, azimuth[i] + 2 * np.pi


@numba.njit(cache=True, nogil=True)
def triangulate(rings, starts, azimuth, points, key, ground, level, below, step, bridge):  # type: ignore[no-untyped-def]
    """Join neighbouring rings by triangles.

    Args:
        rings: (K,) number of each ring, increasing.
        starts: (K + 1,) the first return of each ring, and N.
        azimuth: (N,) radians, increasing within a ring.
        points: (N, 3) float32 metres.
        key: (N,) equal for returns of one object.
        ground: (N,) returns with the label of a ground.
        level, below: of ``find_level`` and ``neighbours_below``.
        step: radians between firings.
        bridge: whether to join a ring with the ring after the next where the next one has no return.

    Returns:
        (T, 3) int32 indices of returns, and (N,) bool, True for returns at the rim of a surface.
    """
    count, limit = len(azimuth), WIDEST * step
    triangles = np.empty((4 * count if bridge else 2 * count, 3), np.int32)
    found, farthest = 0, 2 if bridge else 1
    distance = np.empty(count)
    for i in range(count):
        x, y, z = _exactly(points, i)
        distance[i] = np.sqrt(x * x + y * y + z * z)
    rim = np.zeros(count, np.bool_)
    rim[: starts[1]] = True
    rim[starts[len(rings) - 1] :] = True
    for k in range(len(rings) - 1):
        for further in range(1, farthest + 1):
            if k + further >= len(rings):
                break
            a0, b0 = starts[k], starts[k + further]
            n, m = starts[k + 1] - a0, starts[k + further + 1] - b0
            if rings[k + further] - rings[k] > farthest:
                rim[a0 : a0 + n] = True
                rim[b0 : b0 + m] = True
                continue
            i = j = 0
            a, at_a = a0, azimuth[a0]
            b, at_b = b0, azimuth[b0]
            next_a, to_a = _around(azimuth, a0, 1, n)
            next_b, to_b = _around(azimuth, b0, 1, m)
            joined = _UNKNOWN
            while i < n or j < m:
                from_a, from_b, between, apart = a, b, joined, at_a - at_b
                upper = i < n and (j == m or to_a <= to_b)  # the next return of the upper ring comes first
                if upper:
                    c, before, gap = next_a, a, to_a - at_a
                    i += 1
                    a, at_a = next_a, to_a
                    next_a, to_a = _around(azimuth, a0, i + 1, n)
                else:
                    c, before, gap = next_b, b, to_b - at_b
                    j += 1
                    b, at_b = next_b, to_b
                    next_b, to_b = _around(azimuth, b0, j + 1, m)
                joined = _UNKNOWN
                if further == 2 and (0 <= below[from_a] < b0 or (upper and 0 <= below[c] < b0)):
                    continue  # the ring between has a return
                whole = False
                if gap <= limit and abs(apart) <= limit and abs(at_a - at_b) <= limit:
                    if between == _UNKNOWN:
                        between = _joined(points, distance, key, ground, level, from_a, from_b, True)
                    if between:
                        joined = _joined(points, distance, key, ground, level, a, b, True)
                    if between and joined:
                        whole = _joined(points, distance, key, ground, level, before, c, False) == 1
                if whole:
                    triangles[found, 0], triangles[found, 1], triangles[found, 2] = from_a, from_b, c
                    found += 1
                else:
                    rim[from_a] = rim[from_b] = rim[c] = True
    return triangles[:found], rim


@numba.njit(cache=True, nogil=True)
def rows_above(points, rays, rho, rows):  # type: ignore[no-untyped-def]
    """Fill ``rho`` (N,) with horizontal distances, and ``rows`` (N,) with the number of lasers whose cones pass above
    each point."""
    for i in range(len(points)):
        rho[i] = np.sqrt(points[i, 0] * points[i, 0] + points[i, 1] * points[i, 1])
        low = 0
        high = len(rays.slope)
        while low < high:
            middle = (low + high) // 2
            if rays.height[middle] + rays.slope[middle] * rho[i] > points[i, 2]:
                low = middle + 1
            else:
                high = middle
        rows[i] = low


@numba.njit(cache=True, nogil=True, error_model="numpy")
def hit_triangles(vertices, triangles, rays, nearest):  # type: ignore[no-untyped-def]
    """Find the first triangle that each ray hits.

    Where the cone of a laser passes between the corners of a triangle, one corner is alone on its side. The cone cuts
    the two edges that meet there.

    Args:
        vertices: N ``Vertices``.
        triangles: (T, 3) indices of vertices.
        rays: ``Rays``.
        nearest: ``Nearest``, filled where a triangle is nearer than what is there.
    """
    rows = vertices.rows
    for t in range(len(triangles)):
        i = np.uintp(triangles[t, 0])  # unsigned: no test whether an index counts from the end
        j = np.uintp(triangles[t, 1])
        k = np.uintp(triangles[t, 2])
        top = min(rows[i], rows[j], rows[k])
        bottom = max(rows[i], rows[j], rows[k])
        if top == bottom:
            continue
        normal = _normal(vertices.points, i, j, k)
        for laser in range(top, bottom):
            alone, one, other = _alone_first(rows, laser, i, j, k)
            start = _cut(vertices, rays, laser, alone, one)
            end = _cut(vertices, rays, laser, alone, other)
            _hit_segment(vertices, (alone, one, other), start, end, normal, rays, laser, nearest)


@numba.njit(cache=True, nogil=True, inline="always")
def _alone_first(rows, laser, i, j, k):  # type: ignore[no-untyped-def]
    """The three corners of a triangle, first the one that is alone on its side of a laser's cone."""
    below = rows[i] > laser
    if below == (rows[j] > laser):
        return k, i, j
    if below == (rows[k] > laser):
        return j, k, i
    return i, j, k


@numba.njit(cache=True, nogil=True, inline="always")
def _cut(vertices, rays, laser, p, q):  # type: ignore[no-untyped-def]
    """Where the cone of a laser cuts the edge from p to q: share of the way, x, y, azimuth."""
    points = vertices.points
    over_p = points[p, 2] - rays.height[laser] - rays.slope[laser] * vertices.rho[p]
    over_q = points[q, 2] - rays.height[laser] - rays.slope[laser] * vertices.rho[q]
    share = over_p / (over_p - over_q)
    x = points[p, 0] + share * (points[q, 0] - points[p, 0])
    y = points[p, 1] + share * (points[q, 1] - points[p, 1])
    turn = _turn(vertices.azimuth[q] - vertices.azimuth[p])
    return share, x, y, vertices.azimuth[p] + share * turn


@numba.njit(cache=True, nogil=True, inline="always")
def _hit_segment(vertices, corners, start, end, normal, rays, laser, nearest):  # type: ignore[no-untyped-def]
    """Hit a triangle with the firings of a laser between the two cuts of its edges from the first corner."""
    alone, one, other = corners
    share0, x0, y0, azimuth0 = start
    share1, x1, y1, azimuth1 = end
    low = min(azimuth0, azimuth1) - rays.first[laser]
    high = max(azimuth0, azimuth1) - rays.first[laser]
    if high - low > np.pi:
        return
    firing = int(np.ceil(low / rays.step))
    column = firing % rays.firings
    while firing * rays.step < high:
        dx = rays.directions[laser, column, 0]
        dy = rays.directions[laser, column, 1]
        side0 = x0 * dy - y0 * dx
        side1 = x1 * dy - y1 * dx
        s = min(max(side0 / (side0 - side1), 0.0), 1.0) if side0 != side1 else 0.0
        x = x0 + s * (x1 - x0)
        y = y0 + s * (y1 - y0)
        rho = np.sqrt(x * x + y * y)
        if rho < nearest.rho[laser, column]:
            of_one = (1 - s) * share0
            of_other = s * share1
            of_alone = 1 - of_one - of_other
            closest = alone
            if of_one > of_alone:
                closest = one
            if of_other > max(of_alone, of_one):
                closest = other
            nearest.rho[laser, column] = rho
            nearest.vertex[laser, column] = closest
            value = vertices.value
            nearest.value[laser, column] = of_alone * value[alone] + of_one * value[one] + of_other * value[other]
            squares = normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2]
            length = np.sqrt(squares * (1 + rays.slope[laser] * rays.slope[laser]))
            towards = normal[0] * dx + normal[1] * dy + normal[2] * rays.slope[laser]
            nearest.facing[laser, column] = abs(towards) / length
        firing += 1
        column += 1
        if column == rays.firings:
            column = 0


@numba.njit(cache=True, nogil=True, inline="always")
def _turn(angle):  # type: ignore[no-untyped-def]
    """The difference of two azimuths in [-pi, pi], radians."""
    if angle > np.pi:
        return angle - 2 * np.pi
    if angle < -np.pi:
        return angle + 2 * np.pi
    return angle


@numba.njit(cache=True, nogil=True, inline="always")
def _normal(points, i, j, k):  # type: ignore[no-untyped-def]
    """A vector perpendicular to a triangle, of any length."""
    ax, ay, az = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1], points[j, 2] - points[i, 2]
    bx, by, bz = points[k, 0] - points[i, 0], points[k, 1] - points[i, 1], points[k, 2] - points[i, 2]
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@numba.njit(cache=True, nogil=True, error_model="numpy")
def hit_footprints(vertices, which, reach, shape, upright, rays, front, nearest):  # type: ignore[no-untyped-def]
    """Find the first footprint that each ray hits: the patch of a surface that one return of the source stands for.

    Args:
        vertices: N ``Vertices``.
        which: (R,) indices of the returns.
        reach: (R,) metres along a ray beyond which a footprint ends.
        shape: ``FootprintShape`` of the N returns.
        upright: (3,) the upward direction in the target's frame.
        rays: ``Rays``.
        front: metres, and share of its distance, by which a footprint has to lie in front of a triangle to hide it.
        nearest: ``Nearest`` of ``hit_triangles``, in which footprints replace what they hide.
    """
    points = vertices.points
    found = np.zeros(nearest.rho.shape, np.bool_)  # rays that hit a footprint
    for k in range(len(which)):
        i = which[k]
        away = vertices.rho[i]
        z = points[i, 2]
        nx, ny, nz = _level_or_upright(points, i, shape.level[i], upright)
        x0, y0, z0 = shape.recorded[i, 0], shape.recorded[i, 1], shape.recorded[i, 2]
        distance = np.sqrt(x0 * x0 + y0 * y0 + z0 * z0)
        half = min(shape.half * distance / away, WIDEST_FOOTPRINT)
        above = z + shape.up[i] * distance
        below = z - shape.down[i] * distance
        top = vertices.rows[i]
        while top > 0 and rays.height[top - 1] + rays.slope[top - 1] * away <= above:
            top -= 1
        for laser in range(top, len(rays.slope)):
            if rays.height[laser] + rays.slope[laser] * away <= below:
                break
            over = nx * points[i, 0] + ny * points[i, 1] + nz * (z - rays.height[laser])
            low = vertices.azimuth[i] - half - rays.first[laser]
            firing = int(np.ceil(low / rays.step))
            column = firing % rays.firings
            while firing * rays.step < low + 2 * half:
                dx = rays.directions[laser, column, 0]
                dy = rays.directions[laser, column, 1]
                towards = nx * dx + ny * dy + nz * rays.slope[laser]
                rho = over / towards if over * towards > 0 else away
                beyond = abs(rho - away) > reach[k]
                rho = min(max(rho, NEAREST * away), FARTHEST * away)
                hidden = rho if found[laser, column] else rho * (1 + front[1]) + front[0]
                if hidden < nearest.rho[laser, column] and not beyond:
                    found[laser, column] = True
                    nearest.rho[laser, column] = rho
                    nearest.vertex[laser, column] = i
                    nearest.value[laser, column] = vertices.value[i]
                    nearest.facing[laser, column] = 1.0
                firing += 1
                column += 1
                if column == rays.firings:
                    column = 0


@numba.njit(cache=True, nogil=True, inline="always")
def _level_or_upright(points, i, level, upright):  # type: ignore[no-untyped-def]
    """The normal of a footprint: upward, or horizontal and along the ray of its return."""
    ux, uy, uz = upright[0], upright[1], upright[2]
    if level:
        return ux, uy, uz
    above = points[i, 0] * ux + points[i, 1] * uy + points[i, 2] * uz
    nx, ny, nz = points[i, 0] - above * ux, points[i, 1] - above * uy, points[i, 2] - above * uz
    length = np.sqrt(nx * nx + ny * ny + nz * nz)
    return nx / length, ny / length, nz / length
