"""Range images as pictures with one pixel per cell; cells without a return are dark."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import IGNORE, NAMES, check_labels
from lidar_synth.errors import ConfigError, choose
from lidar_synth.geometry import RangeImage, Scan, require_finite, require_reflectance
from lidar_synth.geometry.projection import project, unproject
from lidar_synth.viz.scales import EMPTY, Rgb, Scale, make_scales

CHANNELS = ("range", "reflectance", "label", "confidence")
"""The channels of a range image that are shown, if it has them."""


class View(NamedTuple):
    """A scan and its range image."""

    scan: Scan
    image: RangeImage

    @property
    def channels(self) -> tuple[str, ...]:
        """The members of ``CHANNELS`` that the range image has."""
        return tuple(_shown(self.image))

    @property
    def classes(self) -> NDArray[np.int64]:
        """(20,) number of points of each class, unlabelled points last; all zero without labels."""
        if self.scan.label is None:
            return np.zeros(len(NAMES) + 1, np.int64)
        return np.bincount(
            np.where(self.scan.label == IGNORE, len(NAMES), self.scan.label),
            minlength=len(NAMES) + 1,
        )


def views(given: Sequence[Scan | RangeImage]) -> list[View]:
    """Project scans to range images (spherical projection), and unproject range images to scans.

    Raises:
        ConfigError: without scans.
        DataError: on points that are NaN or infinite, another reflectance than 0 to 1, or labels
            that are not train ids.
    """
    if not given:
        raise ConfigError("no scans to show", "at least one scan")
    result = []
    for item in given:
        if item.label is not None:
            check_labels(item.label, f"scan {getattr(item, 'id', '')!r}")
        if isinstance(item, Scan):
            require_finite(item)
            require_reflectance(item)
            channels = [name for name in CHANNELS if name in item.fields()]
            result.append(View(item, project(item, channels=channels)))
        else:
            result.append(View(unproject(item), item))
    return result


def _shown(image: RangeImage) -> dict[str, NDArray[Any]]:
    """{name: values (H, W)} of the channels that are shown."""
    channels = {"range": image.range, **image.channels}
    return {name: channels[name] for name in CHANNELS if name in channels}


def picture(
    image: RangeImage, channel: str = "range", scale: Scale | None = None
) -> Rgb:
    """(H, W, 3) uint8 picture of one of the ``CHANNELS``; cells without a return are dark.

    Args:
        image: the range image to show.
        channel: one of ``CHANNELS``.
        scale: the colour scale; by default that of this image alone.

    Raises:
        ConfigError: on a channel that the image does not have.
    """
    values = choose("picture of", channel, _shown(image))
    colours = (scale or make_scales([unproject(image)])[channel])(values)
    return np.where(image.mask[..., None], colours, EMPTY)
