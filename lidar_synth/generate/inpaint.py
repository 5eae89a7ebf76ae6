"""Inpainting of range images by a generator: known cells are kept, the cells of a hole are sampled.

In every step the state outside the hole is the known one at that time, y_t = (1 - t) y0 + t y1 with
y0 the encoded image and y1 the noise; only the state inside the hole follows the flow (Lugmayr et
al., "RePaint", CVPR 2022, for a rectified flow).
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import adaptive_max_pool2d

from lidar_synth.datasets.classes import IGNORE
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.generate.devices import without_autocast
from lidar_synth.generate.flow.solvers import mean_velocity, solve
from lidar_synth.generate.generator import Generator
from lidar_synth.geometry import RangeImage, Sensor

START = 0.6
"""Time from which the flow starts in a hole, so that the large shapes of the provisional content
remain. The steps are those of the model's time grid from the last time at or below it."""


def inpaint(
    generator: Generator,
    images: Sequence[RangeImage],
    holes: Sequence[NDArray[np.bool_]],
    seed: int,
    indices: Sequence[int],
) -> list[RangeImage]:
    """Draw the holes of range images again.

    Args:
        generator: an unconditional model.
        images: B images on the model's grid with provisional content in the holes. Missing labels
            are ignored ones, missing reflectance is 0, missing confidence 1 where there is a label.
        holes: (H, W) each, True for cells to draw.
        seed: seed of the noise, 0 <= seed < 2^64.
        indices: B indices of the noise, 0 <= index < 2^63.

    Returns:
        B images: outside the holes the given values, inside those of the model, with ``confidence``
            if it has labels.

    Raises:
        ConfigError: on a conditional model, or one without a time in (0, ``START``].
        DataError: on images of another sensor.

    Example:
        >>> from lidar_synth import load_generator
        >>> from lidar_synth.generate.inpaint import inpaint
        >>> generator = load_generator("town")
        >>> [image] = generator.range_images(seed=0, indices=[0])
        >>> hole = (image.range > 10) & (image.range < 20)
        >>> [drawn] = inpaint(generator, [image], [hole], seed=1, indices=[0])
        >>> bool((drawn.range[~hole] == image.range[~hole]).all())
        True
    """
    for image in images:
        check_model(generator, image.sensor)
    drawn = []
    for first in range(0, len(images), generator.batch):
        part = slice(first, first + generator.batch)
        drawn += _inpaint_batch(
            generator, images[part], holes[part], seed, indices[part]
        )
    return drawn


def check_model(generator: Generator, sensor: Sensor) -> None:
    """Check that a model can fill holes in scans of a sensor; names and range limits of sensors may
    differ.

    Raises:
        ConfigError: on a conditional model.
        DataError: on different rows or columns.
    """
    if generator.condition is not None:
        raise ConfigError(
            f"{generator.name!r}, a model conditioned on {generator.condition!r}, to fill holes",
            "an unconditional model",
            "Use model='town', or no model.",
        )
    wanted = generator.header.sensor
    if sensor.shape != wanted.shape or not np.array_equal(sensor.edges, wanted.edges):
        raise DataError(
            f"a scan of sensor {sensor.name!r} ({sensor.shape[0]} x {sensor.shape[1]}) for a model "
            f"of {wanted.name!r} ({wanted.shape[0]} x {wanted.shape[1]})",
            "scans on the model's grid",
            f"If the scans fit it, read them with --sensor {wanted.name} (sensor=...). Otherwise "
            "use model=None, or a model that was trained for this sensor.",
        )


def _inpaint_batch(
    generator: Generator,
    images: Sequence[RangeImage],
    holes: Sequence[NDArray[np.bool_]],
    seed: int,
    indices: Sequence[int],
) -> list[RangeImage]:
    """``inpaint`` for the images of one batch."""
    codec = generator.codec
    device = generator.device
    images = [_complete(image) for image in images]
    mask = torch.from_numpy(np.stack(holes)).to(device, torch.float32)[:, None]
    inside = adaptive_max_pool2d(mask, codec.shape[1:]) > 0
    sensor = generator.header.sensor
    noise, draws = generator.draw_noise(seed, indices, sensor)
    with torch.inference_mode(), without_autocast(device):
        known = codec.encode(generator.tensors.from_images(images).to(device))
        state = codec.decode(_sample(generator, known, noise, inside), draws)
    results = []
    for image, hole, new in zip(
        images, holes, generator.tensors.to_images(state, sensor), strict=True
    ):
        channels = {
            n: np.where(hole, v, image.channels[n]) for n, v in new.channels.items()
        }
        results.append(
            RangeImage(np.where(hole, new.range, image.range), image.sensor, channels)
        )
    return results


def _sample(
    generator: Generator, known: Tensor, noise: Tensor, inside: Tensor
) -> Tensor:
    """The states (B, *shape) at time 0, which outside the hole are the known ones.

    Args:
        generator: the model.
        known, noise: (B, *shape) encoded images, and noise.
        inside: (B, 1, h, w) bool, True for the cells of a state to sample.
    """
    grid = [t for t in generator.header.time_grid if t <= START]
    if len(grid) < 2:
        raise ConfigError(
            f"the time grid {tuple(generator.header.time_grid)}, to fill holes",
            f"a time above 0 and up to {START} in it, at which to start",
        )
    y = (1 - grid[0]) * known + grid[0] * noise
    velocity = mean_velocity(generator.network, grid)
    for t, t_next in pairwise(grid):
        y = solve(velocity, y, (t, t_next))
        y = torch.where(inside, y, (1 - t_next) * known + t_next * noise)
    return y


def _complete(image: RangeImage) -> RangeImage:
    """The image with every channel that a model may need, missing ones with default values."""
    unknown = np.full(image.range.shape, IGNORE, np.uint8)
    label = image.channels.get("label", unknown)
    defaults: dict[str, NDArray[Any]] = {
        "reflectance": np.zeros(image.range.shape, np.float32),
        "label": label,
        "confidence": (label != IGNORE).astype(np.float32),
    }
    return RangeImage(image.range, image.sensor, defaults | image.channels)
