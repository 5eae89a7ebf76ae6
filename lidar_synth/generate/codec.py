"""Between range images and the states of a flow: nothing for pixel models, an autoencoder for latent ones.

Everything after the codec (path, solver, selection, distillation, sampling) is the same for both. A tensor is what
``TensorFormat`` makes of range images, (B, C, H, W); a state is what the flow lives on.
"""

from dataclasses import dataclass
from typing import ClassVar, Protocol, cast

import torch
from torch import Tensor, nn

from lidar_synth.errors import DataError
from lidar_synth.geometry.normalize import CHANNELS, TensorFormat


class Codec(Protocol):
    """``shape`` is that of a state, (channels, rows, columns); ``draws``, how many random numbers a cell of an image
    takes; ``decode`` takes back what ``encode`` did."""

    @property
    def shape(self) -> tuple[int, int, int]: ...

    @property
    def draws(self) -> int: ...

    def encode(self, x: Tensor) -> Tensor:
        """Tensors (B, C, H, W) to states (B, *shape)."""
        ...

    def decode(self, y: Tensor, uniform_noise: Tensor | None = None) -> Tensor:
        """States (B, *shape) to tensors (B, C, H, W), drawn by (B, draws, H, W) numbers in (0, 1), or the likeliest."""
        ...


class Autoencoder(Protocol):
    """What a latent codec needs of a network (``VQVAE``).

    Attributes:
        channels: of its images.
        resolution: rows and columns of its images.
        latent_shape: channels, rows and columns of its latents.
        draws: random numbers that a cell of an image takes; 0 where a latent stands for one image.
    """

    channels: int
    resolution: tuple[int, int]
    latent_shape: tuple[int, int, int]
    draws: int

    def encode(self, x: Tensor) -> Tensor:
        """Images (B, C, H, W) to latents of about mean 0 and variance 1."""
        ...

    def decode(self, z: Tensor, uniform_noise: Tensor | None = None) -> Tensor:
        """Latents to images; label bits as logits."""
        ...


@dataclass(frozen=True)
class Identity:
    """The codec of pixel models: a state is a tensor.

    Args:
        shape: C, H, W.
    """

    shape: tuple[int, int, int]
    draws: ClassVar[int] = 0

    def encode(self, x: Tensor) -> Tensor:
        """(B, C, H, W), as it is."""
        return x

    def decode(self, y: Tensor, uniform_noise: Tensor | None = None) -> Tensor:
        """(B, C, H, W), as it is."""
        return y


@dataclass(frozen=True)
class Latent:
    """The codec of latent models.

    Args:
        network: the autoencoder, in evaluation mode.
        tensors: the layout of its images; label bits leave the network as logits.
    """

    network: Autoencoder
    tensors: TensorFormat

    @property
    def shape(self) -> tuple[int, int, int]:
        """Channels, rows and columns of a latent."""
        return self.network.latent_shape

    @property
    def draws(self) -> int:
        """Random numbers per cell."""
        return self.network.draws

    @torch.no_grad()
    def encode(self, x: Tensor) -> Tensor:
        """Tensors (B, C, H, W) to latents before the codebook, float32, mean 0 and variance 1 per channel."""
        return self.network.encode(x).float()

    @torch.no_grad()
    def decode(self, y: Tensor, uniform_noise: Tensor | None = None) -> Tensor:
        """Latents (B, *shape), through the codebook, to tensors (B, C, H, W), drawn by ``uniform_noise`` (B, draws, H,
        W) or the likeliest.

        Raises:
            DataError: on latents of another shape.
        """
        if y.shape[1:] != self.shape:
            raise DataError(f"a latent of shape {tuple(y.shape)}", f"(B, {', '.join(map(str, self.shape))})")
        return expected(self.network.decode(y, uniform_noise).float(), self.tensors)


def expected(output: Tensor, tensors: TensorFormat) -> Tensor:
    """What a decoder's output (B, C, H, W) says: label bits, which it gives as logits, become their expected values
    tanh(x / 2) in (-1, 1); all else is as it is."""
    parts = torch.split(output, [CHANNELS[name] for name in tensors.channels], 1)
    return torch.cat([(p / 2).tanh() if n == "label" else p for n, p in zip(tensors.channels, parts, strict=True)], 1)


def make_codec(network: nn.Module | None, tensors: TensorFormat, resolution: tuple[int, int]) -> Codec:
    """The codec of a model.

    Args:
        network: its autoencoder; None for a pixel model.
        tensors: the layout of its tensors.
        resolution: H, W of the sensor.

    Raises:
        DataError: on an autoencoder of other images.
    """
    if network is None:
        return Identity((tensors.size, *resolution))
    codec = cast(Autoencoder, network)
    given, wanted = (codec.channels, *codec.resolution), (tensors.size, *resolution)
    if given != wanted:
        raise DataError(f"an autoencoder of images of shape {given}", f"{wanted} for {tensors.channels}")
    return Latent(codec, tensors)
