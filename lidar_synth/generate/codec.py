"""Mapping between range images and the states of a flow: the identity for pixel models, an
autoencoder for latent ones.

Everything after the codec (path, solver, selection, distillation, sampling) is the same for both. A
tensor (B, C, H, W) contains range images encoded by ``TensorFormat``; a state is what the flow
generates.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar, Protocol, cast

import torch
from torch import Tensor, nn

from lidar_synth.errors import DataError
from lidar_synth.generate.models.convolution import check_shape
from lidar_synth.generate.models.network import Autoencoder
from lidar_synth.generate.models.objective import expected
from lidar_synth.generate.support import find_unsupported
from lidar_synth.geometry.normalize import TensorFormat


class Codec(Protocol):
    """A pair of mappings; ``decode`` is the approximate inverse of ``encode``.

    Attributes:
        shape: channels, rows and columns of a state.
        draws: number of random numbers per cell for sampling an image; 0 if decoding is
            deterministic.
    """

    @property
    def shape(self) -> tuple[int, int, int]: ...

    @property
    def draws(self) -> int: ...

    def encode(self, x: Tensor) -> Tensor:
        """Tensors (B, C, H, W) to states (B, *shape)."""
        ...

    def decode(
        self,
        y: Tensor,
        uniform_noise: Tensor | None = None,
        given: Mapping[str, Tensor] | None = None,
    ) -> Tensor:
        """States (B, *shape) to tensors (B, C, H, W).

        They are sampled with ``uniform_noise``, (B, draws, H, W) numbers in (0, 1); None = the
        mode. Some autoencoders follow ``given``, {name of a condition: values (B, ...)}, exactly.
        """
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
        """(B, C, H, W), unchanged."""
        return x

    def decode(
        self,
        y: Tensor,
        uniform_noise: Tensor | None = None,
        given: Mapping[str, Tensor] | None = None,
    ) -> Tensor:
        """(B, C, H, W), unchanged."""
        return y


@dataclass(frozen=True)
class Latent:
    """The codec of latent models.

    Args:
        network: the autoencoder, in evaluation mode.
        tensors: the layout of its images; the network returns label bits as logits.
    """

    network: Autoencoder
    tensors: TensorFormat

    @property
    def shape(self) -> tuple[int, int, int]:
        """Channels, rows and columns of a latent."""
        return self.network.latent_shape

    @property
    def draws(self) -> int:
        """Number of random numbers per cell for sampling an image."""
        return self.network.draws

    @torch.no_grad()
    def encode(self, x: Tensor) -> Tensor:
        """Tensors (B, C, H, W) to latents before the codebook, float32, mean 0 and variance 1 per
        channel."""
        return self.network.encode(x).float()

    @torch.no_grad()
    def decode(
        self,
        y: Tensor,
        uniform_noise: Tensor | None = None,
        given: Mapping[str, Tensor] | None = None,
    ) -> Tensor:
        """Latents (B, *shape), quantised if there is a codebook, to tensors (B, C, H, W).

        Args:
            y: latents.
            uniform_noise: (B, draws, H, W) numbers in (0, 1) to sample with; returns without
                support (support.py) are then removed. None = the mode.
            given: {name of a condition: values (B, ...)}; only those named in the autoencoder's
                ``decodes_given`` are used.

        Raises:
            DataError: on latents of another shape.
        """
        check_shape(y, self.shape, "a latent")
        decode: Callable[..., Tensor] = self.network.decode
        used = {
            name: values
            for name, values in (given or {}).items()
            if name in self.network.decodes_given
        }
        # Other autoencoders take no third argument.
        decoded = decode(y, uniform_noise, *([used] if used else []))
        image = expected(decoded.float(), self.tensors)
        if uniform_noise is not None:
            self._clear_unsupported(image[:, 0])  # the range
        return image

    def _clear_unsupported(self, distance: Tensor) -> None:
        """Clear returns without support from sampled ranges (B, H, W), normalised, in place."""
        metres = self.tensors.normalisation.decode(distance).cpu().numpy()
        lost = torch.from_numpy(find_unsupported(metres))
        distance.masked_fill_(lost.to(distance.device), -1.0)


def make_codec(
    network: nn.Module | None, tensors: TensorFormat, resolution: tuple[int, int]
) -> Codec:
    """The codec of a model.

    Args:
        network: the model's autoencoder; None for a pixel model.
        tensors: the layout of the model's tensors.
        resolution: H, W of the sensor.

    Raises:
        DataError: on an autoencoder for images of another shape.
    """
    if network is None:
        return Identity((tensors.size, *resolution))
    codec = cast(Autoencoder, network)
    shape = (codec.channels, *codec.resolution)
    wanted = (tensors.size, *resolution)
    if shape != wanted:
        raise DataError(
            f"an autoencoder for images of shape {shape}",
            f"{wanted} for {tensors.channels}",
        )
    return Latent(codec, tensors)
