"""Compiled kernels: triangles between neighbouring returns, which join neighbouring rings like a
zip."""

import numba
import numpy as np

_compiled = numba.njit(cache=True, nogil=True)
_inlined = numba.njit(cache=True, nogil=True, inline="always")

SAME_RING = np.tan(np.radians(4.0))
SAME_OBJECT = np.tan(np.radians(8.0))
OTHER_OBJECT = np.tan(np.radians(25.0))
"""Smallest angle between a ray and the line from its return to the neighbouring return, for which
both are of one surface (Bogoslavskyi and Stachniss, "Fast range image-based segmentation", IROS
2016): along a ring, between rings, and between returns with different labels or instances."""

NOISE = 0.06
"""Metres; neighbours whose ranges differ by less are of one surface."""

WIDEST = 1.6
"""The widest gap between neighbours of one ring, in firings; a wider one is a ray without a
return."""

_UNKNOWN = -1


@_compiled
def neighbours_below(starts, azimuth, step, bridge, below):  # type: ignore[no-untyped-def]
    """Fill ``below`` (N,) with the nearest return of the next ring within one step of azimuth; -1 =
    none.

    With ``bridge``, a return without one looks in the ring after the next.
    """
    below[:] = -1
    rings = len(starts) - 1
    for k in range(rings - 1):
        for further in range(1, 3 if bridge else 2):
            if k + further >= rings:
                break
            low = starts[k + further]
            high = starts[k + further + 1]
            j = low
            for i in range(starts[k], starts[k + 1]):
                while j + 1 < high and abs(azimuth[j + 1] - azimuth[i]) <= abs(
                    azimuth[j] - azimuth[i]
                ):
                    j += 1
                if below[i] < 0 and j < high and abs(azimuth[j] - azimuth[i]) <= step:
                    below[i] = j


@_compiled
def find_level(points, below, level):  # type: ignore[no-untyped-def]
    """Mark in ``level`` (N,) the returns of nearly level surfaces, such as the road, by their
    neighbour below."""
    level[:] = False
    for i in range(len(points)):
        j = below[i]
        if j >= 0:
            xi, yi, zi = _exactly(points, i)
            xj, yj, zj = _exactly(points, j)
            along = np.sqrt((xi - xj) ** 2 + (yi - yj) ** 2)
            if abs(zi - zj) <= 0.12 * along + 0.02 and along > 0.05:
                level[i] = True
    # the nearest returns of a surface have no neighbour below
    for i in range(len(points)):
        j = below[i]
        if j >= 0 and level[i] and below[j] < 0:
            level[j] = True


@_inlined
def _exactly(points, i):  # type: ignore[no-untyped-def]
    """The coordinates of a float32 point in float64, which differences of near points need."""
    return np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])


@_inlined
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
    cx = yi * zj - zi * yj
    cy = zi * xj - xi * zj
    cz = xi * yj - yi * xj
    least = OTHER_OBJECT if not same else SAME_OBJECT if across else SAME_RING
    return int(
        np.sqrt(cx * cx + cy * cy + cz * cz)
        >= least * (far - (xi * xj + yi * yj + zi * zj))
    )


@_inlined
def _around(azimuth, start, i, count):  # type: ignore[no-untyped-def]
    """Return ``i`` of a ring that begins at ``start``, which may be past its end, and its azimuth,
    radians."""
    if i < count:
        return start + i, azimuth[start + i]
    i = start + (i - count if i < 2 * count else i % count)
    return i, azimuth[i] + 2 * np.pi


@_compiled
def triangulate(  # type: ignore[no-untyped-def]
    rings, starts, azimuth, points, key, ground, level, below, step, bridge
):
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
        bridge: whether to join a ring with the ring after the next where the next one has no
            return.

    Returns:
        (T, 3) int32 indices of returns, and (N,) bool, True for returns at the rim of a surface.
    """
    count = len(azimuth)
    limit = WIDEST * step
    triangles = np.empty((4 * count if bridge else 2 * count, 3), np.int32)
    found = 0
    farthest = 2 if bridge else 1
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
            a0 = starts[k]
            b0 = starts[k + further]
            n = starts[k + 1] - a0
            m = starts[k + further + 1] - b0
            if rings[k + further] - rings[k] > farthest:
                rim[a0 : a0 + n] = True
                rim[b0 : b0 + m] = True
                continue
            i = j = 0
            a = a0
            at_a = azimuth[a0]
            b = b0
            at_b = azimuth[b0]
            next_a, to_a = _around(azimuth, a0, 1, n)
            next_b, to_b = _around(azimuth, b0, 1, m)
            joined = _UNKNOWN
            while i < n or j < m:
                from_a = a
                from_b = b
                between = joined
                apart = at_a - at_b
                # The next return of the upper ring comes first.
                upper = i < n and (j == m or to_a <= to_b)
                if upper:
                    c = next_a
                    before = a
                    gap = to_a - at_a
                    i += 1
                    a = next_a
                    at_a = to_a
                    next_a, to_a = _around(azimuth, a0, i + 1, n)
                else:
                    c = next_b
                    before = b
                    gap = to_b - at_b
                    j += 1
                    b = next_b
                    at_b = to_b
                    next_b, to_b = _around(azimuth, b0, j + 1, m)
                joined = _UNKNOWN
                if further == 2 and (
                    0 <= below[from_a] < b0 or (upper and 0 <= below[c] < b0)
                ):
                    continue  # the ring between has a return
                whole = False
                if gap <= limit and abs(apart) <= limit and abs(at_a - at_b) <= limit:
                    if between == _UNKNOWN:
                        between = _joined(
                            points, distance, key, ground, level, from_a, from_b, True
                        )
                    if between:
                        joined = _joined(
                            points, distance, key, ground, level, a, b, True
                        )
                    if between and joined:
                        whole = (
                            _joined(
                                points, distance, key, ground, level, before, c, False
                            )
                            == 1
                        )
                if whole:
                    triangles[found, 0] = from_a
                    triangles[found, 1] = from_b
                    triangles[found, 2] = c
                    found += 1
                else:
                    rim[from_a] = rim[from_b] = rim[c] = True
    return triangles[:found], rim
