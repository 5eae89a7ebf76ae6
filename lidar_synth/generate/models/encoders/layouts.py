"""Encoder of layout images: classes and distances become maps on the grid of the state."""

from collections.abc import Sequence
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lidar_synth.errors import ConfigError
from lidar_synth.generate.models.convolution import Residual, check_shape, pair, reduced
from lidar_synth.generate.models.network import Encoder
from lidar_synth.geometry.layout.layout import CHANNELS, CHORD_STEP, CODES
from lidar_synth.geometry.layout.raster import depths_of

_FEATURES = len(CODES) + 4
_NEAREST = 1.0
"""Metres; smaller distances look the same."""


class LayoutEncoder(Encoder):
    """Encodes the image of a layout as feature maps on the grid of the state.

    Every cell becomes its class (one-hot), its distance (inverse and logarithm), the ray's way
    through the box and the place along the box. Strided convolutions reduce the cells of the image
    to those of the state.

    Args:
        resolution: H, W of the image.
        target: h, w of the state; H / h and W / w are powers of two.
        channels: of the maps.
        widths: channels after each reduction, the last of which is repeated.
        depth: residual blocks on the grid of the state.

    Raises:
        ConfigError: on an image whose size is not a power of two times the state's.
    """

    derived_arguments: ClassVar[tuple[str, ...]] = ("resolution", "target")
    condition: ClassVar[str] = "layout"
    argument: ClassVar[str] = "condition_channels"

    def __init__(
        self,
        resolution: Sequence[int],
        target: Sequence[int],
        channels: int = 64,
        widths: Sequence[int] = (24, 48, 96),
        depth: int = 2,
    ) -> None:
        super().__init__()
        self.resolution = pair(resolution)
        self.channels = channels
        target = pair(target)
        strides = _strides(self.resolution, target)
        if reduced(self.resolution, strides, "a layout image") != target or not widths:
            raise ConfigError(
                f"a layout image of {self.resolution} for a state of {target}",
                "a power of two times it",
            )
        self.body = nn.Sequential()
        inputs = _FEATURES
        for i, stride in enumerate(strides or [(1, 1)]):
            outputs = widths[min(i, len(widths) - 1)]
            self.body.extend([nn.Conv2d(inputs, outputs, stride, stride), nn.SiLU()])
            inputs = outputs
        self.body.extend([Residual(inputs, inputs, groups=8) for _ in range(depth)])
        self.body.append(nn.Conv2d(inputs, channels, 1))

    def forward(self, image: Tensor) -> Tensor:
        """(B, 5, H, W) uint8, as ``layout_image`` makes it, to (B, channels, h, w).

        Raises:
            DataError: on another size.
        """
        check_shape(image, (len(CHANNELS), *self.resolution), "a layout image")
        out: Tensor = self.body(self._features(image))
        return out

    def _features(self, image: Tensor) -> Tensor:
        """(B, F, H, W), channels last in memory."""
        dtype = next(self.body.parameters()).dtype
        codes = F.one_hot(image[:, 0].long(), len(CODES)).to(dtype)
        depth = depths_of(image)
        chord = image[:, 3].float()
        along = image[:, 4].float()
        known = depth > 0
        near = depth.clamp(min=_NEAREST)
        through = (chord > 0) & known
        values = [
            torch.where(known, 4 / near, 0),
            torch.where(known, near.log() / 2 - 1, 0),
            chord * CHORD_STEP / 2,
            torch.where(through, along / 127.5 - 1, 0),
        ]
        return torch.cat([codes, torch.stack(values, -1).to(dtype)], -1).movedim(-1, 1)


def _strides(
    resolution: tuple[int, int], target: tuple[int, int]
) -> list[tuple[int, int]]:
    """Strides of up to (2, 4), the largest number of columns first."""
    rows, columns = (
        max(1, a // b).bit_length() - 1 for a, b in zip(resolution, target, strict=True)
    )
    first = [(1, 4)] * max(0, (columns - rows + 1) // 2)
    columns -= 2 * len(first)
    while columns < 0:
        first[-1] = (1, 2)
        columns += 1
    return first + [
        (1 + (i < rows), 1 + (i < columns)) for i in range(max(rows, columns))
    ]
