"""Projection and unprojection of batches of torch tensors on any device, bit-identical to those on
the CPU."""

from typing import NamedTuple

import numpy as np
import torch

from lidar_synth.errors import DataError
from lidar_synth.geometry.projection.kernels import (
    ASIN,
    ATAN,
    PI,
    PI_2,
    PI_4,
    TAN_PI_8,
    Grid,
    grid_of,
)
from lidar_synth.geometry.sensor import Sensor

_NONE = torch.iinfo(torch.int64).max


class BatchImage(NamedTuple):
    """A batch of range images.

    Args:
        range: (B, H, W) float32 metres, 0 = no return.
        channels: (B, C, H, W) further values of the points, 0 where there is no return.
        point: (B, H, W) int64 row of ``points`` that a cell shows, -1 = none.
    """

    range: torch.Tensor
    channels: torch.Tensor
    point: torch.Tensor


def _cells(points: torch.Tensor, grid: Grid) -> tuple[torch.Tensor, torch.Tensor]:
    """Cell (N,) int64 and range (N,) float32 of points (N, 3); cell 0 and range inf outside the
    range limits."""
    x, y, z = points.unbind(-1)
    r = torch_sqrt(x * x + y * y + z * z)
    elevation = torch_asin(z / torch.where(r > 0, r, 1.0))
    if len(grid.slopes):
        slopes, lifts, starts = (
            torch.from_numpy(part).to(points.device)
            for part in (grid.slopes, grid.lifts, grid.starts)
        )
        squared = x * x + y * y
        flat = torch_sqrt(squared)[:, None]
        row = (z[:, None] <= lifts[1:-1] + flat * slopes[1:-1]).sum(1)
        rise = z - starts[row]
        r = torch_sqrt(squared + rise * rise)
    elif len(grid.edges):
        inner = torch.from_numpy(grid.edges[1:-1].copy()).to(points.device)
        row = torch.searchsorted(-inner, -elevation.contiguous(), right=True)
    else:
        up, down = torch.tensor([grid.up, grid.down], device=points.device).unbind()
        row = (
            ((1 - (elevation - down) / (up - down)) * grid.rows)
            .clamp(0, grid.rows - 1)
            .long()
        )
    in_range = (r >= float(grid.range_min)) & (r <= float(grid.range_max)) & (r > 0)
    azimuth = -torch_atan2(y, x)
    column = ((azimuth / torch.pi + 1) * 0.5 * grid.columns).long() % grid.columns
    return torch.where(in_range, row * grid.columns + column, 0), torch.where(
        in_range, r, torch.inf
    )


def project_batch(
    points: torch.Tensor, offsets: torch.Tensor, sensor: Sensor
) -> BatchImage:
    """Project a batch of point clouds to range images, each bit for bit as ``project`` does.

    Args:
        points: (N, 3 + C) float32 x, y, z in metres, then C further values; all clouds one after
            another, on any device.
        offsets: (B + 1,) int64, cloud b is ``points[offsets[b]:offsets[b + 1]]``.
        sensor: the sensor that defines the grid.

    Raises:
        DataError: on another dtype or shape, or offsets that do not cover the points.

    Example:
        >>> import torch
        >>> from lidar_synth import load_sensor
        >>> from lidar_synth.geometry.projection.batch import project_batch
        >>> points = torch.tensor([[10, 0.1, -1, 0.3], [12, 4, 0.5, 0.9], [7, -2, -1, 0.2]])
        >>> images = project_batch(points, torch.tensor([0, 2, 3]), load_sensor("hdl64e_kitti"))
        >>> images.range.shape, images.channels.shape
        (torch.Size([2, 64, 1024]), torch.Size([2, 1, 64, 1024]))
        >>> (images.range > 0).sum((1, 2))
        tensor([2, 1])
    """
    if points.dtype != torch.float32 or points.ndim != 2 or points.shape[1] < 3:
        raise DataError(
            f"points {tuple(points.shape)} {points.dtype}",
            "(N, 3 + C) float32: x, y, z in metres, ...",
        )
    if (
        int(offsets[0]) != 0
        or int(offsets[-1]) != len(points)
        or bool((offsets.diff() < 0).any())
    ):
        raise DataError(
            f"offsets {offsets.tolist()} for {len(points)} points",
            "rising from 0 to the number of points",
        )
    height, width = sensor.shape
    batch = len(offsets) - 1
    cell, distance = _cells(points[:, :3], grid_of(sensor))
    cloud = torch.repeat_interleave(
        torch.arange(batch, device=points.device), offsets.diff().to(points.device)
    )
    # Positive floats are ordered like their bit patterns, so one integer minimum over (range bits,
    # point index) finds the nearest point, and the first of points at equal range.
    key = distance.view(torch.int32).long() << 32 | torch.arange(
        len(points), device=points.device
    )
    best = torch.full((batch * height * width,), _NONE, device=points.device)
    in_range = distance < torch.inf
    best.scatter_reduce_(
        0, (cloud * (height * width) + cell)[in_range], key[in_range], "amin"
    )
    point = torch.where(best < _NONE, best & 0xFFFFFFFF, -1).view(batch, height, width)
    # Empty cells (-1) take the last row, which is zeros.
    shown = torch.cat([points, points.new_zeros(1, points.shape[1])])[point]
    distances = torch.cat([distance, distance.new_zeros(1)])[point]
    return BatchImage(distances, shown[..., 3:].movedim(-1, 1), point)


def torch_atan2(y: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    """``atan2`` on float32 tensors of any one shape, bit for bit."""
    ax = x.abs()
    ay = y.abs()
    high = torch.maximum(ax, ay)
    low = torch.minimum(ax, ay)
    q = low / torch.where(high > 0, high, 1.0)
    upper = q > float(TAN_PI_8)
    u = torch.where(upper, (q - 1) / (q + 1), q)
    a = _polynomial(u * u, ATAN) * (u * u) * u + u
    a = torch.where(upper, a + float(PI_4), a)
    a = torch.where(ay > ax, float(PI_2) - a, a)
    a = torch.where(x < 0, float(PI) - a, a)
    return torch.where(y < 0, -a, a)


def torch_sqrt(x: torch.Tensor) -> torch.Tensor:
    """Square root rounded to the nearest float32, which torch's own on a CPU (MKL's) does not
    promise."""
    return x.double().sqrt().float()


def torch_asin(s: torch.Tensor) -> torch.Tensor:
    """``asin`` on a float32 tensor of any shape, bit for bit."""
    a = s.abs()
    outer = a > 0.5
    z = torch.where(outer, 0.5 * (1 - a), a * a)
    u = torch.where(outer, torch_sqrt(z), a)
    p = _polynomial(z, ASIN) * z * u + u
    a = torch.where(outer, float(PI_2) - 2 * p, p)
    return torch.where(s < 0, -a, a)


def _polynomial(z: torch.Tensor, coefficients: tuple[np.float32, ...]) -> torch.Tensor:
    value = torch.full_like(z, float(coefficients[0]))
    for c in coefficients[1:]:
        value = value * z + float(c)
    return value
