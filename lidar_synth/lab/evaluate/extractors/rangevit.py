"""RangeViT (Ando et al., CVPR 2023, https://github.com/valeoai/rangevit) as R3DPA uses it for FRID,
and with remission for FRD: the feature map before the classifier, averaged over eight bands of
rows.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lidar_synth.errors import ConfigError
from lidar_synth.geometry import Scan
from lidar_synth.lab.evaluate.extractors.archive import Archive, load_weights
from lidar_synth.lab.evaluate.extractors.inputs import preparation
from lidar_synth.lab.evaluate.extractors.per_scan import PerScan, some

BACKBONES = {
    "vit_small_patch16_384": (384, 12, 6),
    "vit_base_patch16_384": (768, 12, 12),
    "vit_large_patch16_384": (1024, 24, 16),
}
"""Width, blocks and heads of the transformer by the name in the settings."""

PATCH = (2, 8)
"""Rows and columns of a patch."""
DECODED = 128
"""Channels of the feature map before the classifier."""
BANDS = 8
"""Bands of rows over which features are averaged."""
MEAN = (11.274, 0.076, 0.246, -1.041, 0.215)
DEVIATION = (9.816, 10.239, 7.616, 0.797, 0.181)
"""Of range, x, y, z and remission over KITTI-360, where the weights hold none."""


class _Context(nn.Module):
    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, outputs, 1)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, padding=1)
        self.bn1 = nn.BatchNorm2d(outputs)
        self.conv3 = nn.Conv2d(outputs, outputs, 3, dilation=2, padding=2)
        self.bn2 = nn.BatchNorm2d(outputs)

    def forward(self, x: Tensor) -> Tensor:
        own = F.leaky_relu(self.conv1(x))
        y = self.bn1(F.leaky_relu(self.conv2(own)))
        z: Tensor = own + self.bn2(F.leaky_relu(self.conv3(y)))
        return z


class _Wide(nn.Module):
    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, outputs, 1)
        self.conv2 = nn.Conv2d(inputs, outputs, 3, padding=1)
        self.bn1 = nn.BatchNorm2d(outputs)
        self.conv3 = nn.Conv2d(outputs, outputs, 3, dilation=2, padding=2)
        self.bn2 = nn.BatchNorm2d(outputs)
        self.conv4 = nn.Conv2d(outputs, outputs, 2, dilation=2, padding=1)
        self.bn3 = nn.BatchNorm2d(outputs)
        self.conv5 = nn.Conv2d(3 * outputs, outputs, 1)
        self.bn4 = nn.BatchNorm2d(outputs)

    def forward(self, x: Tensor) -> Tensor:
        first = self.bn1(F.leaky_relu(self.conv2(x)))
        second = self.bn2(F.leaky_relu(self.conv3(first)))
        third = self.bn3(F.leaky_relu(self.conv4(second)))
        together = F.leaky_relu(self.conv5(torch.cat([first, second, third], 1)))
        y: Tensor = F.leaky_relu(self.conv1(x)) + self.bn4(together)
        return y


class _Stem(nn.Module):
    def __init__(
        self,
        channels: int,
        base: int,
        hidden: int,
        width: int,
    ) -> None:
        super().__init__()
        self.conv_block = nn.Sequential(
            _Context(channels, base),
            _Context(base, base),
            _Context(base, base),
            _Wide(base, hidden),
        )
        pool = nn.AvgPool2d(
            (PATCH[0] + 1, PATCH[1] + 1), PATCH, (PATCH[0] // 2, PATCH[1] // 2)
        )
        self.proj_block = nn.Sequential(pool, nn.Conv2d(hidden, width, 1))


class _Attention(nn.Module):
    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(width, 3 * width)
        self.proj = nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        split = self.qkv(x).unflatten(-1, (3, self.heads, -1))
        q, k, v = split.permute(2, 0, 3, 1, 4)
        y: Tensor = self.proj(
            F.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2)
        )
        return y


class _MLP(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(width, 4 * width)
        self.fc2 = nn.Linear(4 * width, width)

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = self.fc2(F.gelu(self.fc1(x)))
        return y


class _TransformerBlock(nn.Module):
    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(width)
        self.attn = _Attention(width, heads)
        self.norm2 = nn.LayerNorm(width)
        self.mlp = _MLP(width)

    def forward(self, x: Tensor) -> Tensor:
        x = x + self.attn(self.norm1(x))
        y: Tensor = x + self.mlp(self.norm2(x))
        return y


class _TransformerEncoder(nn.Module):
    def __init__(
        self,
        stem: _Stem,
        size: tuple[int, int],
        width: int,
        blocks: int,
        heads: int,
    ) -> None:
        super().__init__()
        self.patch_embed = stem
        self._grid = (size[0] // PATCH[0], size[1] // PATCH[1])
        self.cls_token = nn.Parameter(torch.zeros(1, 1, width))
        self.pos_embed = nn.Parameter(
            torch.zeros(1, self._grid[0] * self._grid[1] + 1, width)
        )
        self.blocks = nn.ModuleList(
            _TransformerBlock(width, heads) for _ in range(blocks)
        )
        self.norm = nn.LayerNorm(width)

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """(B, C, H, W) to patches (B, width, H/2, W/8) and the stem's feature map (B, hidden, H,
        W)."""
        fine = self.patch_embed.conv_block(image)
        patches = self.patch_embed.proj_block(fine)
        x = torch.cat(
            [
                self.cls_token.expand(len(image), -1, -1),
                patches.flatten(2).transpose(1, 2),
            ],
            1,
        )
        x = x + self._positions(patches.shape[2:])
        for block in self.blocks:
            x = block(x)
        return self.norm(x)[:, 1:].transpose(1, 2).unflatten(2, patches.shape[2:]), fine

    def _positions(self, grid: torch.Size) -> Tensor:
        if grid.numel() == self._grid[0] * self._grid[1]:
            return self.pos_embed
        maps = self.pos_embed[:, 1:].transpose(1, 2).reshape(1, -1, *self._grid)
        resized = (
            F.interpolate(maps, size=tuple(grid), mode="bilinear")
            .flatten(2)
            .transpose(1, 2)
        )
        return torch.cat([self.pos_embed[:, :1], resized], 1)


class _ConvolutionDecoder(nn.Module):
    def __init__(self, width: int, hidden: int, decoded: int) -> None:
        super().__init__()
        self.up_conv_block = nn.ModuleDict(
            {
                "conv_upsample": nn.Sequential(
                    nn.Conv2d(width, decoded * PATCH[0] * PATCH[1], 1)
                ),
                "conv1": nn.Sequential(
                    nn.Conv2d(decoded + hidden, decoded, 3, padding=1),
                    nn.LeakyReLU(),
                    nn.BatchNorm2d(decoded),
                ),
                "conv_output": nn.Sequential(
                    nn.Conv2d(decoded, decoded, 1),
                    nn.LeakyReLU(),
                    nn.BatchNorm2d(decoded),
                ),
            }
        )

    def forward(self, patches: Tensor, fine: Tensor) -> Tensor:
        """Patches (B, width, h, w) and (B, hidden, 2 h, 8 w) to (B, decoded, 2 h, 8 w)."""
        layers = self.up_conv_block
        x = layers["conv_upsample"](patches).unflatten(1, (-1, *PATCH))
        x = x.permute(0, 1, 4, 2, 5, 3).flatten(4).flatten(2, 3)
        y: Tensor = layers["conv_output"](layers["conv1"](torch.cat([x, fine], 1)))
        return y


class RangeViT(nn.Module):
    """RangeViT without its classifier.

    Args:
        channels: of the input: 4 without remission, 5 with it.
        size: rows and columns for which the position embedding is.
        transformer: width, number of blocks, number of heads.
        base, hidden: channels of the convolutional stem.
        decoded: channels of the feature map.
    """

    image_mean: Tensor
    image_std: Tensor

    def __init__(
        self,
        channels: int,
        size: tuple[int, int],
        transformer: tuple[int, int, int] = (384, 12, 6),
        base: int = 32,
        hidden: int = 128,
        decoded: int = DECODED,
    ) -> None:
        super().__init__()
        self.channels = channels
        stem = _Stem(channels, base, hidden, transformer[0])
        parts = {
            "encoder": _TransformerEncoder(stem, size, *transformer),
            "decoder": _ConvolutionDecoder(transformer[0], hidden, decoded),
        }
        self.rangevit = nn.ModuleDict(parts)
        self.register_buffer("image_mean", torch.tensor(MEAN)[None, :, None, None])
        self.register_buffer("image_std", torch.tensor(DEVIATION)[None, :, None, None])

    def forward(self, image: Tensor) -> Tensor:
        """(B, 5, H, W) range, x, y, z and remission, H a multiple of 8, W of 8, to (B, 8 *
        decoded)."""
        normalised = ((image - self.image_mean) / self.image_std)[:, : self.channels]
        features = self.rangevit["decoder"](*self.rangevit["encoder"](normalised))
        bands: Tensor = features.unflatten(2, (BANDS, -1)).mean((3, 4)).flatten(1)
        return bands


def build(settings: Mapping[str, Any]) -> RangeViT:
    """The network of ``config.yaml``.

    Raises:
        ConfigError: on settings that are missing or not supported.
    """
    try:
        kind = (
            tuple(settings["patch_size"]),
            tuple(settings["patch_stride"]),
            settings["conv_stem"],
            settings["decoder"],
        )
        if (
            kind != (PATCH, PATCH, "ConvStem", "up_conv")
            or settings["skip_filters"] != settings["D_h"]
        ):
            raise ConfigError(
                f"RangeViT with patches, stride, stem and decoder {kind}",
                "2 x 8 patches, ConvStem and up_conv with its skip connection",
            )
        height, width = settings["image_size"]
        transformer = BACKBONES[settings["vit_backbone"]]
        return RangeViT(
            settings["in_channels"],
            (height, width),
            transformer,
            settings["stem_base_channels"],
            settings["D_h"],
        )
    except (KeyError, TypeError, ValueError) as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(
            f"config.yaml lacks or misstates {error}",
            "the settings of R3DPA's RangeViT",
        ) from error


def load_rangevit(path: Path, prepared: str) -> PerScan:
    """An extractor from R3DPA's archive, with ``config.yaml`` and ``model.ckpt``; see
    ``load_extractor``."""
    archive = Archive(path, "R3DPA")
    network = build(archive.yaml("config.yaml"))
    content = archive.weights("model.ckpt")
    state = content.get("state_dict") if isinstance(content, dict) else None
    if isinstance(state, dict):
        state = {
            "image_mean": network.image_mean,
            "image_std": network.image_std,
        } | state
    load_weights(network, state, str(path / "model.ckpt"), extra=True)
    network.eval()
    inputs = preparation(prepared)

    def describe(scan: Scan, generated: bool) -> Tensor:
        image = torch.from_numpy(inputs.image(scan, generated))
        some(image[0][image[0] > 0])
        return network(image[None])[0]  # type: ignore[no-any-return]

    return PerScan(describe)
