"""Encoder of label maps: one-hot classes become maps on the grid of the state."""

from collections.abc import Sequence
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lidar_synth.datasets.classes import IGNORE, NAMES
from lidar_synth.errors import ConfigError
from lidar_synth.generate.models.convolution import check_shape, pair, reduced
from lidar_synth.generate.models.network import Encoder

METHODS = ("rescale", "patches")
"""How a label map is reduced to the grid of the state: LiDM's bilinear halvings, or a learned
matrix per patch."""


class SemanticMapEncoder(Encoder):
    """Encodes a label map as feature maps on the grid of the state.

    Args:
        resolution: H, W of the label map.
        target: h, w of the state; they divide H and W, for "rescale" into powers of two.
        channels: of the maps.
        method: one of ``METHODS``. "rescale" is LiDM's: the one-hot classes are halved bilinearly
            (the columns at every step, the rows at the last steps) and mixed by a 1 x 1
            convolution. It uses only a few cells of each patch; "patches" uses all of them.

    Raises:
        ConfigError: on a label map whose size is not a multiple of the state's, or an unknown
            method.
    """

    derived_arguments: ClassVar[tuple[str, ...]] = ("resolution", "target")
    condition: ClassVar[str] = "semantic"
    argument: ClassVar[str] = "condition_channels"

    def __init__(
        self,
        resolution: Sequence[int],
        target: Sequence[int],
        channels: int = 8,
        method: str = "rescale",
    ) -> None:
        super().__init__()
        self.resolution = pair(resolution)
        self.channels = channels
        self.method = method
        target = pair(target)
        if method not in METHODS:
            raise ConfigError(f"method {method!r}", f"one of {', '.join(METHODS)}")
        patch = (
            max(1, self.resolution[0] // target[0]),
            max(1, self.resolution[1] // target[1]),
        )
        if reduced(self.resolution, [patch], "a label map") != target:
            raise ConfigError(
                f"a label map of {self.resolution} for a state of {target}",
                "a multiple of its size",
            )
        rows, columns = (p.bit_length() - 1 for p in patch)
        count = max(rows, columns)
        self.halvings = [
            (1 + (i >= count - rows), 1 + (i >= count - columns)) for i in range(count)
        ]
        if method == "rescale" and patch != (1 << rows, 1 << columns):
            raise ConfigError(
                f"label maps of {self.resolution} rescaled to {target}",
                "powers of two between them",
            )
        kernel = patch if method == "patches" else (1, 1)
        self.mix = nn.Conv2d(len(NAMES) + 1, channels, kernel, kernel, bias=False)

    def forward(self, labels: Tensor) -> Tensor:
        """(B, H, W) uint8 train ids, 255 = ignore, to (B, channels, h, w).

        Raises:
            DataError: on another size.
        """
        check_shape(labels, self.resolution, "a label map")
        codes = torch.where(labels == IGNORE, len(NAMES), labels.long())
        # Channels last in memory.
        x = F.one_hot(codes, len(NAMES) + 1).movedim(-1, 1).to(self.mix.weight.dtype)
        if self.method == "rescale":
            for rows, columns in self.halvings:
                x = F.interpolate(
                    x,
                    scale_factor=(1 / rows, 1 / columns),
                    mode="bilinear",
                    align_corners=True,
                )
        out: Tensor = self.mix(x)
        return out
