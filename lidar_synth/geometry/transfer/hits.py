"""Compiled kernels: the first hits of a sensor's rays on triangles between returns, and on the
patches at their rims.

Rays of one laser form a cone z = height + slope * rho around the axis, rho = hypot(x, y). A
triangle is cut by the cone in a segment, and the segment is cut by the firings whose azimuth lies
between its ends. So each triangle visits only the rays that hit it.
"""

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from lidar_synth.geometry.arrays import Float64Array

_inlined = numba.njit(cache=True, nogil=True, inline="always")

NEAREST = 0.6
FARTHEST = 1.6
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

    points: Float64Array
    azimuth: Float64Array
    rho: Float64Array
    rows: NDArray[np.int32]
    value: NDArray[np.float32]


class FootprintShape(NamedTuple):
    """The shape of the footprints of N returns.

    Args:
        recorded: (N, 3) metres, in the frame of the sensor that recorded the returns.
        level: (N,) returns of level surfaces; the footprints of others are vertical and face the
            target.
        half: width to either side, metres per metre of distance.
        up, down: (N,) height above and below the return, metres per metre of distance.
    """

    recorded: NDArray[np.float32]
    level: NDArray[np.bool_]
    half: float
    up: Float64Array
    down: Float64Array


class Nearest(NamedTuple):
    """The nearest hit of each ray.

    Args:
        rho: (H, F) horizontal distance, metres; inf = none.
        vertex: (H, F) the nearest of the returns that form the surface.
        value: (H, F) interpolated between them.
        facing: (H, F) cosine of the angle between the ray and the normal.
    """

    rho: Float64Array
    vertex: NDArray[np.int32]
    value: NDArray[np.float32]
    facing: NDArray[np.float32]


@numba.njit(cache=True, nogil=True)
def rows_above(points, rays, rho, rows):  # type: ignore[no-untyped-def]
    """Fill ``rho`` (N,) with horizontal distances, and ``rows`` (N,) with the number of lasers
    whose cones pass above each point."""
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

    Where the cone of a laser passes between the corners of a triangle, one corner is alone on its
    side. The cone cuts the two edges that meet there.

    Args:
        vertices: N ``Vertices``.
        triangles: (T, 3) indices of vertices.
        rays: ``Rays``.
        nearest: ``Nearest``, filled where a triangle is nearer than what is there.
    """
    rows = vertices.rows
    for t in range(len(triangles)):
        # unsigned: no test whether an index counts from the end
        i = np.uintp(triangles[t, 0])
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
            _hit_segment(
                vertices, (alone, one, other), start, end, normal, rays, laser, nearest
            )


@_inlined
def _alone_first(rows, laser, i, j, k):  # type: ignore[no-untyped-def]
    """The three corners of a triangle, first the one that is alone on its side of a laser's
    cone."""
    below = rows[i] > laser
    if below == (rows[j] > laser):
        return k, i, j
    if below == (rows[k] > laser):
        return j, k, i
    return i, j, k


@_inlined
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


@_inlined
def _hit_segment(  # type: ignore[no-untyped-def]
    vertices, corners, start, end, normal, rays, laser, nearest
):
    """Hit a triangle with the firings of a laser between the two cuts of its edges from the first
    corner."""
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
            nearest.value[laser, column] = (
                of_alone * value[alone] + of_one * value[one] + of_other * value[other]
            )
            squares = (
                normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2]
            )
            length = np.sqrt(squares * (1 + rays.slope[laser] * rays.slope[laser]))
            towards = normal[0] * dx + normal[1] * dy + normal[2] * rays.slope[laser]
            nearest.facing[laser, column] = abs(towards) / length
        firing += 1
        column += 1
        if column == rays.firings:
            column = 0


@_inlined
def _turn(angle):  # type: ignore[no-untyped-def]
    """The difference of two azimuths in [-pi, pi], radians."""
    if angle > np.pi:
        return angle - 2 * np.pi
    if angle < -np.pi:
        return angle + 2 * np.pi
    return angle


@_inlined
def _normal(points, i, j, k):  # type: ignore[no-untyped-def]
    """A vector perpendicular to a triangle, of any length."""
    ax = points[j, 0] - points[i, 0]
    ay = points[j, 1] - points[i, 1]
    az = points[j, 2] - points[i, 2]
    bx = points[k, 0] - points[i, 0]
    by = points[k, 1] - points[i, 1]
    bz = points[k, 2] - points[i, 2]
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@numba.njit(cache=True, nogil=True, error_model="numpy")
def hit_footprints(  # type: ignore[no-untyped-def]
    vertices, which, reach, shape, upright, rays, front, nearest
):
    """Find the first footprint that each ray hits: the patch of a surface that one return of the
    source stands for.

    Args:
        vertices: N ``Vertices``.
        which: (R,) indices of the returns.
        reach: (R,) metres along a ray beyond which a footprint ends.
        shape: ``FootprintShape`` of the N returns.
        upright: (3,) the upward direction in the target's frame.
        rays: ``Rays``.
        front: metres, and share of its distance, by which a footprint has to lie in front of a
            triangle to hide it.
        nearest: ``Nearest`` of ``hit_triangles``, in which footprints replace what they hide.
    """
    points = vertices.points
    found = np.zeros(nearest.rho.shape, np.bool_)  # rays that hit a footprint
    for k in range(len(which)):
        i = which[k]
        away = vertices.rho[i]
        z = points[i, 2]
        nx, ny, nz = _level_or_upright(points, i, shape.level[i], upright)
        x0 = shape.recorded[i, 0]
        y0 = shape.recorded[i, 1]
        z0 = shape.recorded[i, 2]
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
                hidden = (
                    rho if found[laser, column] else rho * (1 + front[1]) + front[0]
                )
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


@_inlined
def _level_or_upright(points, i, level, upright):  # type: ignore[no-untyped-def]
    """The normal of a footprint: upward, or horizontal and along the ray of its return."""
    ux = upright[0]
    uy = upright[1]
    uz = upright[2]
    if level:
        return ux, uy, uz
    above = points[i, 0] * ux + points[i, 1] * uy + points[i, 2] * uz
    nx = points[i, 0] - above * ux
    ny = points[i, 1] - above * uy
    nz = points[i, 2] - above * uz
    length = np.sqrt(nx * nx + ny * ny + nz * nz)
    return nx / length, ny / length, nz / length
