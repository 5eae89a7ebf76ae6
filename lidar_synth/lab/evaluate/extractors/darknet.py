"""RangeNet++ (Milioto et al., IROS 2019) with the parameter names of lidar-bonnetal's archives, for
inference.

An encoder of residual blocks halves the columns five times; the decoder doubles them again and adds
the encoder's features of the same width. Rows are kept.
"""

from collections import OrderedDict
from itertools import pairwise

import torch.nn.functional as F
from torch import Tensor, nn

BLOCKS = {21: (1, 1, 2, 2, 1), 53: (1, 2, 8, 8, 4)}
"""Residual blocks of each stage of the encoder, by the name of the network."""

WIDTH = 32
"""Channels of the first feature map."""


class _DarknetResidual(nn.Module):
    def __init__(self, channels: int, between: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels, between, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(between)
        self.conv2 = nn.Conv2d(between, channels, 3, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(channels)

    def forward(self, x: Tensor) -> Tensor:
        y = F.leaky_relu(self.bn1(self.conv1(x)), 0.1)
        return x + F.leaky_relu(self.bn2(self.conv2(y)), 0.1)


def _stage(
    name: str,
    conv: nn.Module,
    inputs: int,
    outputs: int,
    residuals: list[str],
) -> nn.Sequential:
    layers = [
        (name, conv),
        ("bn", nn.BatchNorm2d(outputs)),
        ("relu", nn.LeakyReLU(0.1)),
    ]
    return nn.Sequential(
        OrderedDict(
            layers + [(r, _DarknetResidual(outputs, inputs)) for r in residuals]
        )
    )


class _DarknetEncoder(nn.Module):
    def __init__(self, channels: int, layers: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels, WIDTH, 3, padding=1, bias=False)
        self.bn1 = nn.BatchNorm2d(WIDTH)
        for i, count in enumerate(BLOCKS[layers]):
            inputs = WIDTH << i
            outputs = WIDTH << (i + 1)
            conv = nn.Conv2d(inputs, outputs, 3, stride=(1, 2), padding=1, bias=False)
            self.add_module(
                f"enc{i + 1}",
                _stage(
                    "conv",
                    conv,
                    inputs,
                    outputs,
                    [f"residual_{k}" for k in range(count)],
                ),
            )

    def forward(self, x: Tensor) -> list[Tensor]:
        """Feature maps of widths W, W/2, ..., W/32."""
        maps = [F.leaky_relu(self.bn1(self.conv1(x)), 0.1)]
        for i in range(1, 6):
            maps.append(self.get_submodule(f"enc{i}")(maps[-1]))
        return maps


class _DarknetDecoder(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        for i, (inputs, outputs) in enumerate(
            pairwise(WIDTH << j for j in (5, 4, 3, 2, 1, 0))
        ):
            conv = nn.ConvTranspose2d(
                inputs, outputs, (1, 4), stride=(1, 2), padding=(0, 1)
            )
            self.add_module(
                f"dec{5 - i}", _stage("upconv", conv, inputs, outputs, ["residual"])
            )

    def forward(self, maps: list[Tensor]) -> Tensor:
        """The feature maps of the encoder to (B, WIDTH, H, W)."""
        *skips, x = maps
        for i in (5, 4, 3, 2, 1):
            x = self.get_submodule(f"dec{i}")(x) + skips.pop()
        return x


class RangeNet(nn.Module):
    """RangeNet++ without post-processing.

    Args:
        channels: channels of the input.
        classes: number of classes, the unlabelled class included; 0 for a network without its head.
        layers: 21 or 53.
    """

    def __init__(
        self,
        channels: int = 5,
        classes: int = 20,
        layers: int = 53,
    ) -> None:
        super().__init__()
        self.backbone = _DarknetEncoder(channels, layers)
        self.segmentation_decoder = _DarknetDecoder()
        if classes:
            self.segmentation_head = nn.Sequential(
                nn.Identity(), nn.Conv2d(WIDTH, classes, 3, padding=1)
            )

    def decode(self, x: Tensor) -> Tensor:
        """(B, channels, H, W), W a multiple of 32, to the decoder's feature map (B, WIDTH, H,
        W)."""
        features: Tensor = self.segmentation_decoder(self.backbone(x))
        return features

    def forward(self, x: Tensor) -> Tensor:
        """(B, channels, H, W), W a multiple of 32, to logits (B, classes, H, W)."""
        logits: Tensor = self.segmentation_head(self.decode(x))
        return logits
