"""A look at imported weights: scans of ten steps would show noise or a wrong convention."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lidar_synth.bake.conditions import conditions, conditions_for
from lidar_synth.generate.loading import load_generator
from lidar_synth.geometry import Sensor
from lidar_synth.viz import write_view

STEPS = 10
SCANS = 4
BINS = 8
_WIDTH = 40  # of the longest bar, characters


def check_model(path: Path, condition: str | None = None) -> str:
    """Generate scans with a checkpoint, and draw them beside it.

    Args:
        path: of the checkpoint; the picture has its name, with the suffix .png.
        condition: dataset with the labels or images that a conditional model needs.

    Returns:
        The share of cells with a return and a histogram of ranges, as text.

    Raises:
        ConfigError: on a conditional model without a dataset.
        DataError: on an autoencoder.
        FileError: where the picture cannot be written.
    """
    generator = load_generator(path)
    given = conditions(conditions_for(generator, condition), range(SCANS))
    images = generator.range_images(0, range(SCANS), given, steps=STEPS)
    picture = path.with_suffix(".png")
    write_view(picture, images, title=f"{path.stem}, {STEPS} steps")
    ranges = np.concatenate([image.range[image.mask] for image in images])
    filled = np.mean([image.mask.mean() for image in images])
    lines = [
        f"{SCANS} scans of {STEPS} steps: {100 * filled:.1f} % of the cells have a return",
        "range, m         share of the returns, %",
        *_draw_histogram(ranges, generator.sensor),
        f"picture: {picture}",
    ]
    return "\n".join(lines)


def _draw_histogram(ranges: NDArray[np.float32], sensor: Sensor) -> Iterator[str]:
    """A line for each bin of the sensor's range."""
    edges = np.geomspace(max(sensor.range_min, 1.0), sensor.range_max, BINS + 1)
    counts, _ = np.histogram(ranges, edges)
    for i, share in enumerate(counts / max(1, len(ranges))):
        bar = "#" * round(_WIDTH * share)
        yield f"{edges[i]:5.1f} to {edges[i + 1]:5.1f} {100 * share:6.1f} {bar}"
