"""SqueezeSeg (Wu et al., ICRA 2018, https://arxiv.org/abs/1710.07368) with the parameter names of
lidar-bonnetal's archives, for inference.

The columns are halved by the first convolution and by the pooling before each group of fire
modules; the decoder doubles them again and adds the encoder's features of the same width.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class Fire(nn.Module):
    """1 x 1 convolution to few channels, then the concatenation of a 1 x 1 and a 3 x 3 convolution.

    Args:
        inputs: channels of the input.
        squeezed: channels in between.
        expanded: channels of each of the two outputs.
        upsample: whether the columns are doubled in between.
    """

    def __init__(
        self,
        inputs: int,
        squeezed: int,
        expanded: int,
        upsample: bool = False,
    ) -> None:
        super().__init__()
        self.squeeze = nn.Conv2d(inputs, squeezed, 1)
        if upsample:
            self.upconv = nn.ConvTranspose2d(
                squeezed, squeezed, (1, 4), stride=(1, 2), padding=(0, 1)
            )
        self.expand1x1 = nn.Conv2d(squeezed, expanded, 1)
        self.expand3x3 = nn.Conv2d(squeezed, expanded, 3, padding=1)
        self._upsample = upsample

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs, H, W) to (B, 2 * expanded, H, W or 2 W)."""
        x = F.relu(self.squeeze(x))
        if self._upsample:
            x = F.relu(self.upconv(x))
        return F.relu(torch.cat([self.expand1x1(x), self.expand3x3(x)], 1))


def _pool() -> nn.MaxPool2d:
    return nn.MaxPool2d(3, stride=(1, 2), padding=1)


class _FireEncoder(nn.Module):
    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv1a = nn.Sequential(
            nn.Conv2d(channels, 64, 3, stride=(1, 2), padding=1), nn.ReLU()
        )
        self.conv1b = nn.Conv2d(channels, 64, 1)
        self.fire23 = nn.Sequential(_pool(), Fire(64, 16, 64), Fire(128, 16, 64))
        self.fire45 = nn.Sequential(_pool(), Fire(128, 32, 128), Fire(256, 32, 128))
        self.fire6789 = nn.Sequential(
            _pool(),
            Fire(256, 48, 192),
            Fire(384, 48, 192),
            Fire(384, 64, 256),
            Fire(512, 64, 256),
        )

    def forward(self, x: Tensor) -> list[Tensor]:
        """Feature maps of widths W, W/2, W/4, W/8 and W/16."""
        maps = [self.conv1b(x), self.conv1a(x)]
        for group in (self.fire23, self.fire45, self.fire6789):
            maps.append(group(maps[-1]))
        return maps


class _FireDecoder(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.firedec10 = Fire(512, 64, 128, upsample=True)
        self.firedec11 = Fire(256, 32, 64, upsample=True)
        self.firedec12 = Fire(128, 16, 32, upsample=True)
        self.firedec13 = Fire(64, 16, 32, upsample=True)

    def forward(self, maps: list[Tensor]) -> Tensor:
        """The feature maps of the encoder to (B, 64, H, W)."""
        *skips, x = maps
        for fire in (self.firedec10, self.firedec11, self.firedec12, self.firedec13):
            x = fire(x) + skips.pop()
        return x


class SqueezeSeg(nn.Module):
    """SqueezeSeg without its recurrent CRF.

    Args:
        channels: channels of the input: range, x, y, z, remission.
        classes: number of classes, the unlabelled class included.
    """

    def __init__(self, channels: int = 5, classes: int = 20) -> None:
        super().__init__()
        self.backbone = _FireEncoder(channels)
        self.segmentation_decoder = _FireDecoder()
        self.segmentation_head = nn.Sequential(
            nn.Identity(), nn.Conv2d(64, classes, 3, padding=1)
        )

    def decode(self, x: Tensor) -> Tensor:
        """(B, channels, H, W), W a multiple of 16, to the decoder's feature map (B, 64, H, W)."""
        features: Tensor = self.segmentation_decoder(self.backbone(x))
        return features

    def forward(self, x: Tensor) -> Tensor:
        """(B, channels, H, W), W a multiple of 16, to logits (B, classes, H, W)."""
        logits: Tensor = self.segmentation_head(self.decode(x))
        return logits
