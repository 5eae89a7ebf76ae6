"""The training objective of an autoencoder: the weights of its loss, and the terms that several
architectures share."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lidar_synth.errors import ConfigError
from lidar_synth.geometry.normalize import TensorFormat

CURVE_LENGTH = 4
"""Number of neighbouring cells in a row whose points are averaged, as in LiDM."""


@dataclass(frozen=True)
class Losses:
    """Weights of the terms; 0 = left out.

    Args:
        commitment: of the distance between latents and their codes, as a loss of the encoder.
        codebook: of the same distance, as a loss of the codes.
        geometric: of the distance between points.
        mask: of the decoder's mask.
        adversarial: of the discriminator's output.
        adaptive: multiply ``adversarial`` by the ratio of two gradient norms at the decoder's last
            layer: of all reconstruction terms, and of the adversarial term (Esser et al., Eq. 7).
        discriminator_width: channels of the discriminator.
        noise: standard deviation of the noise added to the latents of "surfaces", which lie in
            (-1, 1).
        rare: exponent of the class weights of "surfaces": the weight of a cell is the share of its
            class in the batch to the power of -rare, so that rare classes such as poles count more.
        unlabelled: share of the images that "surfaces" encodes without labels and decodes with
            them.

    Raises:
        ConfigError: on a negative weight.
    """

    # Used when a configuration is validated.
    __pydantic_config__ = {"extra": "forbid"}  # noqa: RUF012

    commitment: float = 0.25
    codebook: float = 1.0
    geometric: float = 0.0
    mask: float = 1.0
    adversarial: float = 0.0
    adaptive: bool = False
    discriminator_width: int = 32
    noise: float = 0.07
    rare: float = 0.0
    unlabelled: float = 0.0

    def __post_init__(self) -> None:
        if min(value for value in vars(self).values()) < 0:
            raise ConfigError(f"{self}", "weights of at least 0")


@dataclass(frozen=True)
class Objective:
    """The training objective of an autoencoder.

    Args:
        tensors: layout of its images.
        rays: (3, H, W) directions of the cells, in units of 1 / maximum range.
        losses: weights of the terms.
        metric: error of the reconstruction, of two tensors of one shape.
        weights: {channel: weight in the reconstruction}, 1 by default.
        discriminator: the network that judges images, if there is an adversarial term.
    """

    tensors: TensorFormat
    rays: Tensor
    losses: Losses
    metric: Callable[[Tensor, Tensor], Tensor]
    weights: Mapping[str, float]
    discriminator: nn.Module | None = None

    def reconstruction(self, output: Tensor, x: Tensor) -> Tensor:
        """The weighted sum over channels, a scalar: the metric, or cross-entropy of label bits."""
        loss = output.new_zeros(())
        wanted = self.tensors.parts(x)
        for name, given in self.tensors.parts(output).items():
            error = _cross_entropy if name == "label" else self.metric
            part = error(given, wanted[name]).mean()
            loss = loss + self.weights.get(name, 1.0) * part
        return loss

    def points(self, x: Tensor) -> Tensor:
        """(B, 3, H, W / 4) mean points of neighbouring cells, in units of the maximum range."""
        return F.avg_pool2d(self._metres(x) * self.rays, (1, CURVE_LENGTH))

    def returned(self, x: Tensor) -> Tensor:
        """(B, 1, H, W) 1 where there is a return, -1 elsewhere."""
        return 2 * (self._metres(x) > 0).to(x.dtype) - 1

    def _metres(self, x: Tensor) -> Tensor:
        """(B, 1, H, W) ranges."""
        return self.tensors.normalisation.decode(self.tensors.parts(x)["range"])


def _cross_entropy(logits: Tensor, bits: Tensor) -> Tensor:
    """Mean cross-entropy of label bits, -1 and 1, under their logits."""
    return F.binary_cross_entropy_with_logits(logits, (bits + 1) / 2)


def expected(output: Tensor, tensors: TensorFormat) -> Tensor:
    """The expected values of a decoder's output (B, C, H, W): label bits x, which are logits,
    become tanh(x / 2) in (-1, 1); other channels are unchanged."""
    parts = tensors.parts(output)
    if "label" in parts:
        parts["label"] = (parts["label"] / 2).tanh()
    return torch.cat(list(parts.values()), 1)
