"""Range images as pictures: a cell is a pixel, a cell without a return is dark."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import IGNORE, NAMES
from lidar_synth.errors import ConfigError
from lidar_synth.geometry.projection import project, unproject
from lidar_synth.geometry.scan import RangeImage, Scan
from lidar_synth.viz.colour import EMPTY, Rgb, Scale, scales

CHANNELS = ("range", "reflectance", "label")
"""What a range image is shown by, where it has it."""


class View(NamedTuple):
    """One scan both ways, as points and on its sensor's grid."""

    scan: Scan
    image: RangeImage

    @property
    def channels(self) -> tuple[str, ...]:
        """Those of ``CHANNELS`` that it has."""
        return tuple(name for name in CHANNELS if name == "range" or name in self.image.channels)

    @property
    def classes(self) -> NDArray[np.int64]:
        """(20,) points of each class, the unlabelled ones last; all zero without labels."""
        if self.scan.label is None:
            return np.zeros(len(NAMES) + 1, np.int64)
        return np.bincount(np.where(self.scan.label == IGNORE, len(NAMES), self.scan.label), minlength=len(NAMES) + 1)


def views(given: Sequence[Scan | RangeImage]) -> list[View]:
    """Each scan with its range image (spherical), each range image with its points."""
    return [
        View(one, project(one, channels=[n for n in CHANNELS if n in one.fields()]))
        if isinstance(one, Scan)
        else View(unproject(one), one)
        for one in given
    ]


def picture(image: RangeImage, channel: str = "range", scale: Scale | None = None) -> Rgb:
    """(H, W, 3) uint8 picture of one of the ``CHANNELS``; cells without a return are dark.

    Args:
        image: what to show.
        channel: one of ``CHANNELS``.
        scale: the meaning of the colours; by default that of a scan of the image's sensor.

    Raises:
        ConfigError: on a channel that the image does not have.
    """
    has = ("range", *(name for name in CHANNELS if name in image.channels))
    if channel not in has:
        raise ConfigError(f"a picture of {channel!r}", f"one of {', '.join(has)}")
    values = image.range if channel == "range" else image.channels[channel]
    colours = (scale or scales([unproject(image)])[channel])(values)
    return np.where(image.mask[..., None], colours, EMPTY)
