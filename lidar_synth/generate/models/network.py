"""Base classes of all networks that a checkpoint can hold. Class attributes state what a training
run provides."""

from abc import abstractmethod
from collections.abc import Iterable
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from lidar_synth.generate.models.objective import Objective


class Network(nn.Module):
    """A velocity network, an autoencoder, or an encoder of conditions (``Encoder``).

    Attributes:
        derived_arguments: names of the arguments that a training run sets itself. For a velocity
            network or an autoencoder: some of "resolution" and "channels" (of the states or images)
            and "normalisation" (its name). For an encoder: some of "resolution" (of the sensor),
            "target" (rows and columns of the state) and "image" (rows and columns of the camera's
            images).
        needs_ray_angles: whether a network with fresh weights takes ``angles``, (2, H, W) elevation
            and azimuth of the cells of the state in radians; a checkpoint stores them among the
            weights.
        decodes_given: the conditions that its ``decode`` takes and follows exactly: "layout"
            (objects in their boxes only) and "semantic" (the labels of the map).
    """

    derived_arguments: ClassVar[tuple[str, ...]] = ("resolution", "channels")
    needs_ray_angles: ClassVar[bool] = False
    decodes_given: ClassVar[frozenset[str]] = frozenset()


class Autoencoder(Network):
    """Range images (B, C, H, W) to latents (B, *latent_shape) and back.

    Attributes:
        channels: number of channels of an image.
        resolution: rows and columns of an image.
        latent_shape: channels, rows and columns of a latent.
        draws: number of random numbers per cell for sampling an image; 0 if decoding is
            deterministic.
    """

    channels: int
    resolution: tuple[int, int]
    latent_shape: tuple[int, int, int]
    draws: int
    shift: Tensor
    scale: Tensor

    def add_scale(self, channels: int) -> None:
        """Add the buffers by which latents have mean 0 and variance 1 per channel, as a flow from
        standard normal noise needs."""
        self.register_buffer("shift", torch.zeros(channels))
        self.register_buffer("scale", torch.ones(channels))

    def normed(self, z: Tensor) -> Tensor:
        """Latents (B, *latent_shape) with mean 0 and variance 1."""
        return (z - self.shift[:, None, None]) / self.scale[:, None, None]

    def bounded(self, z: Tensor) -> Tensor:
        """The inverse of ``normed``."""
        return z * self.scale[:, None, None] + self.shift[:, None, None]

    @abstractmethod
    def encode(self, x: Tensor) -> Tensor:
        """Images to latents of approximate mean 0 and variance 1."""

    @abstractmethod
    def decode(self, z: Tensor, uniform_noise: Tensor | None = None) -> Tensor:
        """Latents to images; label bits as logits."""

    @abstractmethod
    def loss(self, x: Tensor, noise: Tensor, objective: Objective) -> Tensor:
        """The training loss of images, a scalar; ``noise`` is standard normal, of their shape."""

    def __getstate__(self) -> dict[str, Any]:
        state: dict[str, Any] = super().__getstate__()  # type: ignore[no-untyped-call]
        # of a compiled one, which would decode with this network's weights
        state.pop("decode", None)
        return state

    def measure(self, images: Iterable[Tensor], objective: Objective) -> None:
        """Set the values that are measured on images (1, C, H, W) instead of trained."""


class Encoder(Network):
    """An encoder of conditions, trained with the velocity network. It takes conditions as they are
    stored, uint8.

    Attributes:
        condition: the kind of condition that it encodes, a key of
            ``generate.conditions.CONDITIONS``.
        argument: the velocity network's argument that takes ``channels``: "condition_channels" for
            maps on the grid of the state, "context_channels" for tokens.
        mirrors: whether a mirrored condition is encoded as that of a mirrored scan.
        channels: number of channels of the maps or tokens.
    """

    derived_arguments: ClassVar[tuple[str, ...]] = ()
    mirrors: ClassVar[bool] = True
    condition: ClassVar[str]
    argument: ClassVar[str]
    channels: int
