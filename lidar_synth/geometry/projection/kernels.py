"""Compiled kernels of the projection: the cell of a point on a sensor's grid, and the loops over
points and cells.

elevation = asin(z / r) and azimuth = -atan2(y, x). Row and column follow from them as in the paper
and in the public code of R2Flow and LiDM, with the same float32 operations in the same order.

``atan2`` and ``asin`` are polynomials (Cephes ``atanf``, ``asinf``; error about 3e-7 rad). They
have no branches, so that the compiler can vectorise them, and use only IEEE +, -, *, / and sqrt, so
that numba on a CPU and torch on any device (batch.py) give the same bits.

Everything that is compiled for ``project`` is in this one file: numba's cache on disk detects a
change of the file that defines a function, but not of a file whose functions were inlined into it.
"""

from functools import lru_cache
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from lidar_synth.geometry.sensor import Sensor

_compiled = numba.njit(error_model="numpy", cache=True)
_inlined = numba.njit(inline="always")

MARGIN = 1e-6
"""Part of the range limits by which a point may lie beyond them: the rounding error of float32
points, so that a return at a limit is kept when it is projected again."""

_f = np.float32
ATAN = tuple(
    map(_f, (8.05374449538e-2, -1.38776856032e-1, 1.99777106478e-1, -3.33329491539e-1))
)
ASIN = tuple(
    map(
        _f,
        (
            4.2163199048e-2,
            2.4181311049e-2,
            4.5470025998e-2,
            7.4953002686e-2,
            1.6666752422e-1,
        ),
    )
)
_A0, _A1, _A2, _A3 = ATAN
_S0, _S1, _S2, _S3, _S4 = ASIN
PI = _f(np.pi)
PI_2 = _f(np.pi / 2)
PI_4 = _f(np.pi / 4)
TAN_PI_8 = _f(np.tan(np.pi / 8))
_INF = np.float32(np.inf)
_BLOCK = 1024  # points per block, so that the buffers fit into the L1 cache
_ZERO = _f(0)
_HALF = _f(0.5)
_ONE = _f(1)
_TWO = _f(2)


class Grid(NamedTuple):
    """A sensor's grid in the form that the kernels take.

    Args:
        up, down: edges of the field of view, radians.
        edges: (H+1,) edges of the rows, highest first, radians; empty where rows are linear.
        slopes: (H+1,) tangents of the edges; empty unless lasers start above the origin.
        lifts: (H+1,) metres above the origin at which the edges start; as ``slopes``.
        starts: (H,) metres above the origin at which the lasers start; as ``slopes``.
        rows, columns: H, W.
        range_min, range_max: metres, inclusive; ``MARGIN`` beyond the sensor's limits.
    """

    up: np.float32
    down: np.float32
    edges: NDArray[np.float32]
    slopes: NDArray[np.float32]
    lifts: NDArray[np.float32]
    starts: NDArray[np.float32]
    rows: int
    columns: int
    range_min: np.float32
    range_max: np.float32


@lru_cache(maxsize=16)
def grid_of(sensor: Sensor) -> Grid:
    """The ``Grid`` of a sensor."""
    up = np.radians(_f(sensor.up))
    down = np.radians(_f(sensor.down))
    none = np.empty(0, np.float32)
    # Copies: torch warns of read-only arrays, and numba would compile for them once more.
    edges = sensor.edges.copy() if sensor.elevations is not None else none
    starts = sensor.starts.copy()
    slopes = lifts = none
    if len(starts):
        slopes = np.tan(edges)
        between = (starts[1:] + starts[:-1]) / 2
        lifts = np.concatenate([starts[:1], between, starts[-1:]])
    near = _f(sensor.range_min * (1 - MARGIN))
    far = _f(sensor.range_max * (1 + MARGIN))
    return Grid(up, down, edges, slopes, lifts, starts, *sensor.shape, near, far)


@_inlined
def atan2(y, x):  # type: ignore[no-untyped-def]  # float32 scalars, compiled
    """Angle of (x, y) in [-pi, pi], radians, float32."""
    ax = abs(x)
    ay = abs(y)
    high = max(ax, ay)
    low = min(ax, ay)
    q = low / (high if high > _ZERO else _ONE)
    upper = q > TAN_PI_8
    u = (q - _ONE) / (q + _ONE) if upper else q
    z = u * u
    a = (((_A0 * z + _A1) * z + _A2) * z + _A3) * z * u + u
    a = a + PI_4 if upper else a
    a = PI_2 - a if ay > ax else a
    a = PI - a if x < _ZERO else a
    return -a if y < _ZERO else a


@_inlined
def asin(s):  # type: ignore[no-untyped-def]  # float32 scalars, compiled
    """Arc sine of s in [-1, 1], radians, float32."""
    a = abs(s)
    outer = a > _HALF
    z = _HALF * (_ONE - a) if outer else a * a
    u = np.sqrt(z) if outer else a
    p = ((((_S0 * z + _S1) * z + _S2) * z + _S3) * z + _S4) * z * u + u
    a = PI_2 - _TWO * p if outer else p
    return -a if s < _ZERO else a


@_inlined
def column_of(azimuth, columns):  # type: ignore[no-untyped-def]
    """Column of an azimuth (radians, clockwise); +pi wraps to column 0."""
    column = np.int32((azimuth / PI + _ONE) * _HALF * _f(columns))
    return np.int32(0) if column >= columns else column


@_inlined
def row_of(elevation, up, down, rows):  # type: ignore[no-untyped-def]
    """Row of an elevation (radians) where rows are linear; the first or last row outside the field
    of view."""
    row = (_ONE - (elevation - down) / (up - down)) * _f(rows)
    return np.int32(min(max(row, _ZERO), _f(rows) - _ONE))


@_inlined
def row_of_lasers(z, flat, slopes, lifts):  # type: ignore[no-untyped-def]
    """Row of a point at height z and horizontal distance ``flat`` (metres) between edges that start
    above the origin; the first or last row outside the field of view."""
    low = 1
    high = len(slopes) - 1
    while low < high:
        middle = (low + high) // 2
        if z <= lifts[middle] + flat * slopes[middle]:
            low = middle + 1
        else:
            high = middle
    return np.int32(low - 1)


@_compiled
def _locate_block(x, y, z, grid, cell, distance):  # type: ignore[no-untyped-def]
    """Cells and ranges of one block of points; outside the range limits: cell 0, range inf."""
    up = grid.up
    down = grid.down
    rows = np.int32(grid.rows)
    columns = np.int32(grid.columns)
    low = grid.range_min
    high = grid.range_max
    for i in range(len(x)):
        r = np.sqrt(x[i] * x[i] + y[i] * y[i] + z[i] * z[i])
        in_range = (r >= low) & (r <= high) & (r > 0)
        elevation = asin(z[i] / (r if r > 0 else np.float32(1)))
        flat_index = row_of(elevation, up, down, rows) * columns + column_of(
            -atan2(y[i], x[i]), columns
        )
        cell[i] = flat_index if in_range else np.int32(0)
        distance[i] = r if in_range else _INF
    if len(grid.slopes) > 0:  # ranges are measured from the lasers
        for i in range(len(x)):
            squared = x[i] * x[i] + y[i] * y[i]
            row = row_of_lasers(z[i], np.sqrt(squared), grid.slopes, grid.lifts)
            rise = z[i] - grid.starts[row]
            r = np.sqrt(squared + rise * rise)
            in_range = (r >= low) & (r <= high) & (r > 0)
            distance[i] = r if in_range else _INF
            cell[i] = (
                row * columns + column_of(-atan2(y[i], x[i]), columns)
                if in_range
                else np.int32(0)
            )
    elif len(grid.edges) > 0:
        for i in range(len(x)):
            if distance[i] < _INF:
                # At no distance, lasers' edges are where they start: here, the elevations.
                elevation = asin(z[i] / distance[i])
                row = row_of_lasers(elevation, _ZERO, grid.edges, grid.edges)
                cell[i] = cell[i] % columns + row * columns


@numba.njit(error_model="numpy", cache=True, inline="always")
def _scatter(cell, distance, start, image, index):  # type: ignore[no-untyped-def]
    """Write points start, start + 1, ... into their cells where they are nearer than the existing
    ones."""
    for i in range(len(cell)):
        c = cell[i]
        r = distance[i]
        if r < image[c]:
            image[c] = r
            index[c] = start + i


@numba.njit(error_model="numpy", cache=True, inline="always")
def _mark_empty(image, index):  # type: ignore[no-untyped-def]
    """Set cells without a point to range 0 and index -1."""
    for c in range(len(image)):
        if image[c] == _INF:
            image[c] = 0
            index[c] = -1


@_compiled
def nearest_points(points, grid, image, index):  # type: ignore[no-untyped-def]
    """Fill ``image`` (H*W,) with the smallest range per cell (0 = none) and ``index`` with its
    point (-1 = none)."""
    x = np.empty(_BLOCK, np.float32)
    y = np.empty(_BLOCK, np.float32)
    z = np.empty(_BLOCK, np.float32)
    cell = np.empty(_BLOCK, np.int32)
    distance = np.empty(_BLOCK, np.float32)
    image[:] = _INF
    for start in range(0, len(points), _BLOCK):
        n = min(_BLOCK, len(points) - start)
        for i in range(n):
            x[i] = points[start + i, 0]
            y[i] = points[start + i, 1]
            z[i] = points[start + i, 2]
        _locate_block(x[:n], y[:n], z[:n], grid, cell, distance)
        _scatter(cell[:n], distance[:n], start, image, index)
    _mark_empty(image, index)


@_compiled
def nearest_in_cells(cell, distance, image, index):  # type: ignore[no-untyped-def]
    """``nearest_points`` for points with given cells (N,), -1 = none."""
    image[:] = _INF
    for i in range(len(cell)):
        if cell[i] >= 0:
            _scatter(cell[i : i + 1], distance[i : i + 1], i, image, index)
    _mark_empty(image, index)


@_compiled
def locate_points(points, grid, cell, distance):  # type: ignore[no-untyped-def]
    """Fill ``cell`` (N,) with the cell of each point (-1 outside the range limits) and ``distance``
    with its range."""
    x = points[:, 0].copy()
    y = points[:, 1].copy()
    z = points[:, 2].copy()
    _locate_block(x, y, z, grid, cell, distance)
    for i in range(len(points)):
        if distance[i] == _INF:
            cell[i] = -1
            distance[i] = np.sqrt(x[i] * x[i] + y[i] * y[i] + z[i] * z[i])


@_compiled
def gather(values, index, empty, out):  # type: ignore[no-untyped-def]
    for c in range(len(index)):
        out[c] = values[index[c]] if index[c] >= 0 else empty


@_compiled
def returns_in(image):  # type: ignore[no-untyped-def]
    """Number of cells of ``image`` (H*W,) with a return; -1 if any range is negative or not
    finite."""
    n = 0
    valid = True
    for c in range(len(image)):
        n += image[c] > 0
        valid &= (image[c] >= 0) & (image[c] < _INF)
    return n if valid else -1


# The two loops below write every cell to the next free position, and advance that position only for
# a return: this is faster than an unpredictable branch. ``out`` therefore has one element more than
# there are returns.


@_compiled
def along_rays(image, directions, out):  # type: ignore[no-untyped-def]
    """Fill ``out`` (N + 1, 3) with the points of the N returns in ``image`` (H*W,) along
    ``directions`` (H*W, 3)."""
    n = 0
    for c in range(len(image)):
        r = image[c]
        # All loads come before the stores, because the compiler must assume that ``out`` aliases
        # the inputs.
        x = r * directions[c, 0]
        y = r * directions[c, 1]
        z = r * directions[c, 2]
        out[n, 0] = x
        out[n, 1] = y
        out[n, 2] = z
        n += r > 0


@numba.njit(cache=True)
def pick_returns(image, values, out):  # type: ignore[no-untyped-def]
    """Fill ``out`` (N + 1,) with the ``values`` (H*W,) of the N returns in ``image`` (H*W,)."""
    n = 0
    for c in range(len(image)):
        out[n] = values[c]
        n += image[c] > 0


@_compiled
def put_in_rows(cell, rows, columns):  # type: ignore[no-untyped-def]
    """Move each point with a cell (N,) to the row (N,) of its laser, in place."""
    for i in range(len(cell)):
        if cell[i] >= 0:
            cell[i] = rows[i] * columns + cell[i] % columns


@_compiled
def turns_of(points, azimuth, flat):  # type: ignore[no-untyped-def]
    """Fill ``azimuth`` (N,) with radians counter-clockwise from straight ahead, in [0, 2 pi], and
    ``flat`` (N,) with the horizontal distance."""
    x = points[:, 0].copy()
    y = points[:, 1].copy()
    for i in range(len(x)):
        angle = atan2(y[i], x[i])
        azimuth[i] = angle if angle >= _ZERO else angle + _TWO * PI
        flat[i] = np.sqrt(x[i] * x[i] + y[i] * y[i])


@_compiled
def elevations_from(points, height, elevation):  # type: ignore[no-untyped-def]
    """Fill ``elevation`` (N,) with radians above the horizon, seen from ``height`` metres above the
    origin."""
    x = points[:, 0].copy()
    y = points[:, 1].copy()
    z = points[:, 2].copy()
    for i in range(len(x)):
        elevation[i] = atan2(z[i] - height, np.sqrt(x[i] * x[i] + y[i] * y[i]))


@_compiled
def count_octants(points, counts):  # type: ignore[no-untyped-def]
    """Count the points (N, 3) of each of eight equal sectors of azimuth in ``counts`` (8,), in any
    order."""
    for i in range(len(points)):
        x = points[i, 0]
        y = points[i, 1]
        counts[4 * (x < _ZERO) + 2 * (y < _ZERO) + (abs(x) < abs(y))] += 1


@_compiled
def _median(values, start, end, few):  # type: ignore[no-untyped-def]
    """The median of a few values; ``few`` is a buffer for them."""
    n = end - start
    for i in range(n):
        value = values[start + i]
        j = i
        while j > 0 and few[j - 1] > value:
            few[j] = few[j - 1]
            j -= 1
        few[j] = value
    return (few[(n - 1) // 2] + few[n // 2]) * _HALF


@_compiled
def steps_at(values, places, width, steps):  # type: ignore[no-untyped-def]
    """Fill ``steps`` (K,) with the median of ``width`` values (N,) before each place less that of
    those from it on."""
    few = np.empty(width, values.dtype)
    for k in range(len(places)):
        i = places[k]
        before = _median(values, max(i - width, 0), i, few)
        steps[k] = before - _median(values, i, min(i + width, len(values)), few)


@_compiled
def decreases(azimuth, flat, least, motion, places, limits):  # type: ignore[no-untyped-def]
    """Find the points whose azimuth (N,) decreases by more than ``least`` and a shift of ``motion``
    metres of both.

    Fills ``places`` (N,) with their indices and ``limits`` (N,) with the decrease that each has to
    exceed, and returns their number.
    """
    found = 0
    for i in range(1, len(azimuth)):
        drop = azimuth[i - 1] - azimuth[i]
        if drop > least:
            near = _ONE / max(flat[i], _f(0.1))
            before = _ONE / max(flat[i - 1], _f(0.1))
            limit = least + motion * (near + before)
            if drop > limit:
                places[found] = i
                limits[found] = limit
                found += 1
    return found


@_compiled
def sines_of(points, sine):  # type: ignore[no-untyped-def]
    """Fill ``sine`` (N,) with the sine of each point's elevation; 0 at the origin."""
    x = points[:, 0].copy()
    y = points[:, 1].copy()
    z = points[:, 2].copy()
    for i in range(len(x)):
        distance = np.sqrt(x[i] * x[i] + y[i] * y[i] + z[i] * z[i])
        sine[i] = z[i] / (distance if distance > _ZERO else _ONE)


@_compiled
def medians(values, bounds, middle):  # type: ignore[no-untyped-def]
    """Fill ``middle`` (K,) with the median of each part of ``values`` (N,) between K + 1 bounds."""
    for k in range(len(middle)):
        middle[k] = np.median(values[bounds[k] : bounds[k + 1]])


@_compiled
def spreads(values, bounds, middle, spread):  # type: ignore[no-untyped-def]
    """Fill ``spread`` (K,) with the median distance of each part of ``values`` (N,) from its
    ``middle`` (K,)."""
    for k in range(len(middle)):
        spread[k] = np.median(np.abs(values[bounds[k] : bounds[k + 1]] - _f(middle[k])))


@_compiled
def heights_of(points, bounds, out):  # type: ignore[no-untyped-def]
    """Fill ``out`` (N,) with the heights of the lasers by pairs of near and distant neighbours of a
    ring, and return their number."""
    found = 0
    last_inverse = _ZERO
    last_sine = _ZERO
    for k in range(len(bounds) - 1):
        for i in range(bounds[k], bounds[k + 1]):
            x = points[i, 0]
            y = points[i, 1]
            z = points[i, 2]
            distance = max(np.sqrt(x * x + y * y + z * z), _f(0.1))
            inverse = _ONE / distance
            sine = z / distance
            step = inverse - last_inverse
            if i > bounds[k] and abs(step) > _f(0.02):
                out[found] = (sine - last_sine) / step
                found += 1
            last_inverse = inverse
            last_sine = sine
    return found
