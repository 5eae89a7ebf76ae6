"""The owner of arctan2: where a point lies on a sensor's grid.

elevation = asin(z / r), azimuth = -atan2(y, x), row and column from them as in the paper and the
public code of R2Flow and LiDM, float32 operation by operation.

The inverse functions are polynomials (Cephes ``atanf``, ``asinf``; error about 3e-7 rad), written
without branches so that the compiler turns them into vector instructions, and made of nothing but
IEEE +, -, *, / and sqrt so that numba on a CPU and torch on any device give the same bits.
"""

from typing import NamedTuple

import numba
import numpy as np
import torch
from numpy.typing import NDArray

from lidar_synth.sensor import Sensor

_f = np.float32
_ATAN = tuple(map(_f, (8.05374449538e-2, -1.38776856032e-1, 1.99777106478e-1, -3.33329491539e-1)))
_ASIN = tuple(map(_f, (4.2163199048e-2, 2.4181311049e-2, 4.5470025998e-2, 7.4953002686e-2, 1.6666752422e-1)))
_A0, _A1, _A2, _A3 = _ATAN
_S0, _S1, _S2, _S3, _S4 = _ASIN
_PI, _PI_2, _PI_4, _TAN_PI_8 = _f(np.pi), _f(np.pi / 2), _f(np.pi / 4), _f(np.tan(np.pi / 8))
_ZERO, _HALF, _ONE, _TWO = _f(0), _f(0.5), _f(1), _f(2)


class Grid(NamedTuple):
    """A sensor's grid as the kernels take it.

    Args:
        up, down: edges of the field of view, radians.
        edges: (H+1,) edges of the rows, highest first, radians; empty where rows are linear.
        rows, columns: H, W.
        range_min, range_max: metres, inclusive.
    """

    up: np.float32
    down: np.float32
    edges: NDArray[np.float32]
    rows: int
    columns: int
    range_min: np.float32
    range_max: np.float32


def grid_of(sensor: Sensor) -> Grid:
    """The grid of a sensor."""
    up, down = np.radians(_f(sensor.up)), np.radians(_f(sensor.down))
    edges = sensor.edges if sensor.elevations is not None else np.empty(0, np.float32)
    return Grid(up, down, edges, *sensor.shape, _f(sensor.range_min), _f(sensor.range_max))


@numba.njit(inline="always")
def atan2(y, x):  # type: ignore[no-untyped-def]  # float32 scalars, compiled
    """Angle of (x, y) in [-pi, pi], radians, float32."""
    ax, ay = abs(x), abs(y)
    high, low = max(ax, ay), min(ax, ay)
    q = low / (high if high > _ZERO else _ONE)
    upper = q > _TAN_PI_8
    u = (q - _ONE) / (q + _ONE) if upper else q
    z = u * u
    a = (((_A0 * z + _A1) * z + _A2) * z + _A3) * z * u + u
    a = a + _PI_4 if upper else a
    a = _PI_2 - a if ay > ax else a
    a = _PI - a if x < _ZERO else a
    return -a if y < _ZERO else a


@numba.njit(inline="always")
def asin(s):  # type: ignore[no-untyped-def]  # float32 scalars, compiled
    """Arc sine of s in [-1, 1], radians, float32."""
    a = abs(s)
    outer = a > _HALF
    z = _HALF * (_ONE - a) if outer else a * a
    u = np.sqrt(z) if outer else a
    p = ((((_S0 * z + _S1) * z + _S2) * z + _S3) * z + _S4) * z * u + u
    a = _PI_2 - _TWO * p if outer else p
    return -a if s < _ZERO else a


@numba.njit(inline="always")
def column_of(azimuth, columns):  # type: ignore[no-untyped-def]
    """Column of an azimuth (radians, clockwise); +pi wraps to column 0."""
    column = np.int32((azimuth / _PI + _ONE) * _HALF * _f(columns))
    return np.int32(0) if column >= columns else column


@numba.njit(inline="always")
def row_of(elevation, up, down, rows):  # type: ignore[no-untyped-def]
    """Row of an elevation (radians) where rows are linear; outside the field of view, the nearest."""
    row = (_ONE - (elevation - down) / (up - down)) * _f(rows)
    return np.int32(min(max(row, _ZERO), _f(rows) - _ONE))


@numba.njit(inline="always")
def row_in_table(elevation, edges):  # type: ignore[no-untyped-def]
    """Row of an elevation (radians) between tabulated edges; outside the field of view, the nearest."""
    low, high = 1, len(edges) - 1
    while low < high:
        middle = (low + high) // 2
        if elevation <= edges[middle]:
            low = middle + 1
        else:
            high = middle
    return np.int32(low - 1)


def torch_atan2(y: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    """``atan2`` on float32 tensors of any one shape, bit for bit."""
    ax, ay = x.abs(), y.abs()
    high, low = torch.maximum(ax, ay), torch.minimum(ax, ay)
    q = low / torch.where(high > 0, high, 1.0)
    upper = q > float(_TAN_PI_8)
    u = torch.where(upper, (q - 1) / (q + 1), q)
    a = _polynomial(u * u, _ATAN) * (u * u) * u + u
    a = torch.where(upper, a + float(_PI_4), a)
    a = torch.where(ay > ax, float(_PI_2) - a, a)
    a = torch.where(x < 0, float(_PI) - a, a)
    return torch.where(y < 0, -a, a)


def torch_sqrt(x: torch.Tensor) -> torch.Tensor:
    """Square root rounded to the nearest float32, which torch's own on a CPU (MKL's) does not promise."""
    return x.double().sqrt().float()


def torch_asin(s: torch.Tensor) -> torch.Tensor:
    """``asin`` on a float32 tensor of any shape, bit for bit."""
    a = s.abs()
    outer = a > 0.5
    z = torch.where(outer, 0.5 * (1 - a), a * a)
    u = torch.where(outer, torch_sqrt(z), a)
    p = _polynomial(z, _ASIN) * z * u + u
    a = torch.where(outer, float(_PI_2) - 2 * p, p)
    return torch.where(s < 0, -a, a)


def _polynomial(z: torch.Tensor, coefficients: tuple[np.float32, ...]) -> torch.Tensor:
    value = torch.full_like(z, float(coefficients[0]))
    for c in coefficients[1:]:
        value = value * z + float(c)
    return value
