"""Compiled kernels: triangles between neighbouring returns, and the first hits of a sensor's rays on them.

Triangles join neighbouring rings like a zip. Rays of one laser form a cone z = height + slope * rho around the axis,
rho = hypot(x, y). A triangle is cut by the cone in a segment, and the segment is cut by the firings whose azimuth lies
between its ends. So each triangle visits only the rays that hit it.
"""

import numba
import numpy as np

INF = np.inf
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
            along = np.hypot(points[i, 0] - points[j, 0], points[i, 1] - points[j, 1])
            if abs(points[i, 2] - points[j, 2]) <= 0.12 * along + 0.02 and along > 0.05:
                level[i] = True
    for i in range(len(points)):  # the nearest returns of a surface have no neighbour below
        j = below[i]
        if j >= 0 and level[i] and below[j] < 0:
            level[j] = True


@numba.njit(cache=True, nogil=True, inline="always")
def _joined(points, distance, key, ground, level, i, j, across):  # type: ignore[no-untyped-def]
    """1 if two neighbouring returns are of one surface, else 0."""
    if abs(distance[i] - distance[j]) < NOISE:
        return 1
    xi, yi, zi, xj, yj, zj = points[i, 0], points[i, 1], points[i, 2], points[j, 0], points[j, 1], points[j, 2]
    ri, rj = xi * xi + yi * yi + zi * zi, xj * xj + yj * yj + zj * zj
    far = max(ri, rj)
    same = key[i] == key[j]
    if across and (same or (ground[i] and ground[j])) and level[i] and level[j]:
        return int(abs(zi - zj) < 0.1 + 0.03 * np.hypot(xi - xj, yi - yj))
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
        points: (N, 3) metres.
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
        distance[i] = np.sqrt(points[i, 0] * points[i, 0] + points[i, 1] * points[i, 1] + points[i, 2] * points[i, 2])
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
def rows_above(rho, z, slope, height, rows):  # type: ignore[no-untyped-def]
    """Fill ``rows`` (N,) with the number of lasers whose cones pass above each point."""
    for i in range(len(rho)):
        rows[i] = _above(rho[i], z[i], slope, height)


@numba.njit(cache=True, nogil=True, inline="always")
def _above(rho, z, slope, height):  # type: ignore[no-untyped-def]
    low, high = 0, len(slope)
    while low < high:
        middle = (low + high) // 2
        if height[middle] + slope[middle] * rho > z:
            low = middle + 1
        else:
            high = middle
    return low


@numba.njit(cache=True, nogil=True, error_model="numpy")
def hit_triangles(  # type: ignore[no-untyped-def]
    points, azimuth, rho, rows, value, triangles, slope, height, first, step, table, out, vertex, mean, facing
):
    """Find the first triangle that each ray hits.

    Args:
        points, azimuth, rho, rows: (N, ...) returns in the target's frame; ``rows`` of ``rows_above``.
        value: (N,) is interpolated.
        triangles: (T, 3).
        slope, height, first, step: of ``Rays``.
        table: (H, F, 2) x and y of the rays' directions, or empty.
        out: (H, F) rho of the hit, metres; inf = none. Nearer hits replace what is there.
        vertex: (H, F) the nearest corner of the triangle.
        mean: (H, F) the interpolated value.
        facing: (H, F) cosine of the angle between the ray and the normal.
    """
    firings, known = out.shape[1], table.shape[1]
    end, weight = np.zeros((2, 6)), np.zeros(3)  # of each end of the segment: x, y, azimuth, weights of the corners
    for t in range(len(triangles)):
        corner = triangles[t]
        origin = azimuth[corner[0]]
        top = min(rows[corner[0]], rows[corner[1]], rows[corner[2]])
        bottom = max(rows[corner[0]], rows[corner[1]], rows[corner[2]])
        if top == bottom:
            continue
        nx, ny, nz = _normal(points, corner[0], corner[1], corner[2])
        for r in range(top, bottom):
            ends = 0
            for e in range(3):
                p, q = corner[e], corner[(e + 1) % 3]
                if (rows[p] <= r) == (rows[q] <= r):
                    continue
                over_p = points[p, 2] - height[r] - slope[r] * rho[p]
                over_q = points[q, 2] - height[r] - slope[r] * rho[q]
                w = over_p / (over_p - over_q)
                end[ends, 0] = points[p, 0] + w * (points[q, 0] - points[p, 0])
                end[ends, 1] = points[p, 1] + w * (points[q, 1] - points[p, 1])
                at_p = _turn(azimuth[p] - origin)
                end[ends, 2] = at_p + w * _turn(azimuth[q] - azimuth[p])
                end[ends, 3 + e], end[ends, 3 + (e + 1) % 3], end[ends, 3 + (e + 2) % 3] = 1 - w, w, 0
                ends += 1
            low, high = min(end[0, 2], end[1, 2]) + origin, max(end[0, 2], end[1, 2]) + origin
            if ends < 2 or high - low > np.pi:
                continue
            f = int(np.ceil((low - first[r]) / step))
            while first[r] + f * step < high:
                if 0 <= f < known:
                    dx, dy = table[r, f, 0], table[r, f, 1]
                else:
                    dx, dy = np.cos(first[r] + f * step), -np.sin(first[r] + f * step)
                side0, side1 = end[0, 0] * dy - end[0, 1] * dx, end[1, 0] * dy - end[1, 1] * dx
                s = min(max(side0 / (side0 - side1), 0.0), 1.0) if side0 != side1 else 0.0
                x, y = end[0, 0] + s * (end[1, 0] - end[0, 0]), end[0, 1] + s * (end[1, 1] - end[0, 1])
                along, column = np.hypot(x, y), f % firings
                f += 1
                if along >= out[r, column]:
                    continue
                out[r, column] = along
                for e in range(3):
                    weight[e] = end[0, 3 + e] + s * (end[1, 3 + e] - end[0, 3 + e])
                mean[r, column] = (
                    weight[0] * value[corner[0]] + weight[1] * value[corner[1]] + weight[2] * value[corner[2]]
                )
                vertex[r, column] = corner[np.argmax(weight)]
                facing[r, column] = abs(nx * dx + ny * dy + nz * slope[r]) / np.sqrt(1 + slope[r] * slope[r])


@numba.njit(cache=True, nogil=True, inline="always")
def _turn(angle):  # type: ignore[no-untyped-def]
    """The same angle in [-pi, pi], radians."""
    return angle - 2 * np.pi * np.rint(angle / (2 * np.pi))


@numba.njit(cache=True, nogil=True, inline="always")
def _normal(points, i, j, k):  # type: ignore[no-untyped-def]
    ax, ay, az = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1], points[j, 2] - points[i, 2]
    bx, by, bz = points[k, 0] - points[i, 0], points[k, 1] - points[i, 1], points[k, 2] - points[i, 2]
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    length = np.sqrt(nx * nx + ny * ny + nz * nz) + 1e-12
    return nx / length, ny / length, nz / length


@numba.njit(cache=True, nogil=True)
def hit_footprints(points, azimuth, rho, normal, half, up, down, reach, slope, height, first, step, out, vertex):  # type: ignore[no-untyped-def]
    """Find the first footprint that each ray hits: the patch of a surface that one return of the source stands for.

    Args:
        points, azimuth, rho: (N, ...) returns in the target's frame.
        normal: (N, 3) of each footprint, unit length.
        half: (N,) radians to either side.
        up, down: (N,) metres above and below the return.
        reach: (N,) metres along a ray beyond which it ends.
        slope, height, first, step: of ``Rays``.
        out: (H, F) rho of the hit, metres; inf = none. Nearer hits replace what is there.
        vertex: (H, F) the return.
    """
    firings = out.shape[1]
    for i in range(len(points)):
        nx, ny, nz = normal[i, 0], normal[i, 1], normal[i, 2]
        x, y, z, distance = points[i, 0], points[i, 1], points[i, 2], rho[i]
        top, bottom = _above(distance, z + up[i], slope, height), _above(distance, z - down[i], slope, height)
        for r in range(top, bottom):
            f = int(np.ceil((azimuth[i] - half[i] - first[r]) / step))
            while first[r] + f * step < azimuth[i] + half[i]:
                dx, dy = np.cos(first[r] + f * step), -np.sin(first[r] + f * step)
                over = nx * x + ny * y + nz * (z - height[r])
                towards = nx * dx + ny * dy + nz * slope[r]
                along = over / towards if over * towards > 0 else distance
                beyond = abs(along - distance) > reach[i]
                along = min(max(along, NEAREST * distance), FARTHEST * distance)
                column = f % firings
                if along < out[r, column] and not beyond:
                    out[r, column] = along
                    vertex[r, column] = i
                f += 1


@numba.njit(cache=True, nogil=True)
def shape_footprints(recorded, points, rho, rim, level, step, rise, fall, upright, half, up, down, normal):  # type: ignore[no-untyped-def]
    """Fill half, up, down and normal of the footprints of R returns, see ``hit_footprints``.

    Args:
        recorded: (N, 3) float32, the returns in the frame of the sensor that recorded them.
        points, rho: (N, ...) in the target's frame.
        rim: (R,) indices of the returns.
        level: (N,) returns of level surfaces; the footprints of others are vertical and face the target.
        step: radians between the recording sensor's firings.
        rise, fall: (N,) radians, half the angle to its neighbouring rings.
        upright: (3,) the upward direction in the target's frame.
    """
    ux, uy, uz = upright[0], upright[1], upright[2]
    for k in range(len(rim)):
        i = rim[k]
        x, y, z = recorded[i, 0], recorded[i, 1], recorded[i, 2]
        distance = np.sqrt(x * x + y * y + z * z)
        half[k] = min(np.float32(np.float32(step / 2) * distance) / rho[i], 0.2)
        up[k], down[k] = np.tan(rise[i]) * distance, np.tan(fall[i]) * distance
        nx, ny, nz = ux, uy, uz
        if not level[i]:
            above = points[i, 0] * ux + points[i, 1] * uy + points[i, 2] * uz
            nx, ny, nz = points[i, 0] - above * ux, points[i, 1] - above * uy, points[i, 2] - above * uz
            length = np.sqrt(nx * nx + ny * ny + nz * nz)
            nx, ny, nz = nx / length, ny / length, nz / length
        normal[k, 0], normal[k, 1], normal[k, 2] = nx, ny, nz


@numba.njit(cache=True, nogil=True)
def put_in_front(patch, of, rim, value, least, share, out, vertex, mean, facing):  # type: ignore[no-untyped-def]
    """Let footprints hide the triangles that they lie in front of.

    Args:
        patch, of: (H, F) out and vertex of ``hit_footprints``.
        rim, value: (R,) returns of the footprints; (N,) value of each return.
        least, share: metres, and share of its distance, by which a footprint has to lie in front.
        out, vertex, mean, facing: (H, F) of ``hit_triangles``.
    """
    for r in range(out.shape[0]):
        for f in range(out.shape[1]):
            if patch[r, f] * (1 + share) + least < out[r, f]:
                i = rim[of[r, f]]
                out[r, f], vertex[r, f], mean[r, f], facing[r, f] = patch[r, f], i, value[i], 1.0
