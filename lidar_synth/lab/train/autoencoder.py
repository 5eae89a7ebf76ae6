"""Training of autoencoders: the losses, and the reconstruction errors in metres.

An autoencoder trains in the same loop as a flow: one network, one optimiser, one loss::

    reconstruction   the recipe's metric per channel, with the recipe's weights; label bits by cross-entropy
    codebook         squared distance of latents to their codes: ``commitment`` moves the encoder, ``codebook`` a
                     "gradient" codebook; an "ema" codebook follows by moving averages
    mask             distance of the decoder's mask, where it has one, to 1 = return and -1 = none
    geometric        squared distance of points, each the mean of four neighbours in a row, in units of the
                     maximum range: preserves the curves that the beams trace
    adversarial      a discriminator of patches, with the hinge loss (Esser et al., "Taming Transformers for
                     High-Resolution Image Synthesis", CVPR 2021). Both networks are trained in every step:
                     the autoencoder's term uses the discriminator with frozen weights, the discriminator's term
                     uses detached reconstructions

The architectures "autoencoder" and "surfaces" predict distributions. Their loss is the negative
log-likelihood of the
scan: of the return, of the class, and, given a return, of the range and the other values.
    "surfaces" takes them
together, with ``weights`` as exponents of the likelihoods of range and reflectance.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lidar_synth.datasets.classes import IGNORE
from lidar_synth.errors import ConfigError
from lidar_synth.generate.codec import Latent, expected
from lidar_synth.generate.flow.path import Example, Metric
from lidar_synth.generate.models.convolution import Norm, WrapConv
from lidar_synth.generate.models.lidm.vqvae import VQVAE, Reconstruction
from lidar_synth.generate.models.surface_codec.autoencoder import SurfaceAutoencoder
from lidar_synth.generate.models.surface_codec.blocks import PATCH, to_patches
from lidar_synth.generate.models.surface_codec.measure_noise import measure_noise
from lidar_synth.generate.models.surface_codec.surfaces import Surfaces
from lidar_synth.generate.models.town_codec.autoencoder import Autoencoder
from lidar_synth.generate.models.town_codec.distributions import CellDistributions
from lidar_synth.geometry.normalize import CHANNELS, TensorFormat, encode_labels
from lidar_synth.geometry.scan import RangeImage
from lidar_synth.geometry.sensor import Sensor
from lidar_synth.lab.train.data import Batch, Batches

CURVE_LENGTH = 4
"""Number of neighbouring cells in a row whose points are averaged, as in LiDM."""

MEASURED = 8
"""Scans on which the noise of cells is measured."""

_QUERIES = 2048  # points whose nearest neighbours are searched


@dataclass(frozen=True)
class Losses:
    """Weights of the terms; 0 = left out.

    Args:
        commitment: of the distance between latents and their codes, as a loss of the encoder.
        codebook: of the same distance, as a loss of a "gradient" codebook.
        geometric: of the distance between points.
        mask: of the decoder's mask.
        adversarial: of the discriminator's output.
        adaptive: multiply ``adversarial`` by the ratio of two gradient norms at the decoder's last
            layer: of all reconstruction terms, and of the adversarial term (Esser et al., Eq. 7).
        discriminator_width: channels of the discriminator.
        noise: standard deviation of the noise added to the latents of an "autoencoder", which lie
            in (-1, 1).
        rare: exponent of the class weights of an "autoencoder": the weight of a cell is the share
            of its class in the batch to the power of -rare. Poles cover one per cent of a scan, but
            matter more than that.
        unlabelled: share of the images whose labels an "autoencoder" or "surfaces" decodes without
            having seen them.

    Raises:
        ConfigError: on a negative weight.
    """

    __pydantic_config__ = {"extra": "forbid"}  # noqa: RUF012  # used when a configuration is validated

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


class Autoencoding(nn.Module):
    """The trained module: the autoencoder and, with an adversarial term, its discriminator.

    Args:
        network: the autoencoder.
        tensors: layout of its images.
        sensor: its rays turn ranges into points.
        losses: weights of the terms.
        metric: of the reconstruction.
        weights: {channel: weight}, 1 by default.
    """

    rays: Tensor

    def __init__(
        self,
        network: VQVAE | Autoencoder | SurfaceAutoencoder,
        tensors: TensorFormat,
        sensor: Sensor,
        losses: Losses,
        metric: Metric,
        weights: Mapping[str, float],
    ) -> None:
        super().__init__()
        self.network = network
        self.tensors = tensors
        self.losses = losses
        self.metric = metric
        self.weights = weights
        self.discriminator = (
            Discriminator(tensors.size, losses.discriminator_width) if losses.adversarial else None
        )
        directions = (
            torch.from_numpy(sensor.ray_directions().copy()).movedim(-1, 0) / sensor.range_max
        )
        self.register_buffer("rays", directions, persistent=False)

    def forward(self, x: Tensor, noise: Tensor | None = None) -> Tensor:
        """The loss of a batch of tensors (B, C, H, W), a scalar; ``noise`` is standard normal, of
        the same shape."""
        if isinstance(self.network, Autoencoder | SurfaceAutoencoder):
            shape = self.network.latent_shape
            noise = torch.zeros_like(x) if noise is None else noise
            some = noise.flatten(1)[:, : math.prod(shape)].reshape(-1, *shape)
            return self.nll(self.network(self._shown(x, noise), self.losses.noise * some), x)
        encoding: Reconstruction = self.network(x)
        output, mask = encoding.output.float().tensor_split([self.tensors.size], 1)
        loss = self.reconstruction(output, x)
        if mask.shape[1]:
            loss = loss + self.losses.mask * self.metric(mask, self._returned(x)).mean()
        if self.losses.geometric:
            loss = (
                loss
                + self.losses.geometric
                * (self._points(output) - self._points(x)).square().sum(1).mean()
            )
        if self.discriminator is not None:
            loss = loss + self._adversarial(
                self.discriminator, expected(output, self.tensors), x, loss
            )
        loss = loss + self.losses.commitment * encoding.gap.mean()
        return loss + self.losses.codebook * encoding.code_gap.mean()

    def _shown(self, x: Tensor, noise: Tensor) -> Tensor:
        """The images (B, C, H, W), some of them without labels."""
        if not self.losses.unlabelled:
            return x
        assert isinstance(self.network, Autoencoder | SurfaceAutoencoder)
        bits = self.network.bits
        blank = encode_labels(torch.full_like(x[:, 0], IGNORE, dtype=torch.uint8))
        chosen = torch.special.ndtr(noise[:, -1, -1, -1]) < self.losses.unlabelled
        hidden = torch.cat([x[:, :-bits], blank.to(x)], 1)
        return torch.where(chosen.view(-1, 1, 1, 1), hidden, x)

    def finish(self, data: Batches) -> None:
        """Set what is not trained but measured, on the first scans: the noise of "surfaces"."""
        if isinstance(self.network, SurfaceAutoencoder):
            images = (data(range(i, i + 1)).y0 for i in range(MEASURED))
            measure_noise(self.network, ((x, _code(x[:, 2:])) for x in images), self.losses.noise)

    def reconstruction(self, output: Tensor, x: Tensor) -> Tensor:
        """The weighted sum over channels, a scalar."""
        sizes = [CHANNELS[name] for name in self.tensors.channels]
        loss = output.new_zeros(())
        outputs = torch.split(output, sizes, 1)
        wanted = torch.split(x, sizes, 1)
        for name, a, b in zip(self.tensors.channels, outputs, wanted, strict=True):
            label = name == "label"
            part = (
                F.binary_cross_entropy_with_logits(a, (b + 1) / 2)
                if label
                else self.metric(a, b).mean()
            )
            loss = loss + self.weights.get(name, 1.0) * part
        return loss

    def nll(self, predicted: CellDistributions | Surfaces, x: Tensor) -> Tensor:
        """The negative log-likelihood of images (B, C, H, W) under the predicted distributions, a
        scalar."""
        if isinstance(predicted, Surfaces):
            return self._nll_of_surfaces(predicted, x)
        return self._nll_of_cells(predicted, x)

    def _nll_of_surfaces(self, surfaces: Surfaces, x: Tensor) -> Tensor:
        code = _code(x[:, 2:])
        distance, value, weight = to_patches(
            torch.cat([x[:, :2], self._rarity(code, surfaces.classes.shape[2])[:, None]], 1), PATCH
        ).unbind(1)
        codes = to_patches(code[:, None], PATCH)[:, 0]
        temper = self.weights.get("range", 1.0), self.weights.get("reflectance", 1.0)
        likely = surfaces.log_likelihood(distance, value, codes, self.tensors.normalisation, temper)
        return -(weight * likely).sum() / weight.sum()

    def _nll_of_cells(self, heads: CellDistributions, x: Tensor) -> Tensor:
        count = 1 + heads.readings.middles.shape[1]
        distance = x[:, :1]
        values = x[:, 1:count]
        returned = (distance > -1).float()
        nll = [heads.surfaces.nll(distance), heads.readings.nll(values)]
        loss = F.binary_cross_entropy_with_logits(heads.returned.float(), returned)
        weight = torch.ones_like(returned)
        if codes := heads.classes.shape[1]:
            code = _code(x[:, count:])
            weight = self._rarity(code, codes)[:, None]
            unlikely = F.cross_entropy(heads.classes.float(), code, reduction="none")
            loss = (
                loss
                + self.weights.get("label", 1.0) * (weight[:, 0] * unlikely).sum() / weight.sum()
            )
        weight = weight * returned
        means = (torch.cat(nll, 1) * weight).sum((0, 2, 3)) / weight.sum().clamp(min=1)
        for name, mean in zip(self.tensors.channels, means, strict=False):  # the label has no mean
            loss = loss + self.weights.get(name, 1.0) * mean
        return loss

    def _rarity(self, code: Tensor, codes: int) -> Tensor:
        """(B, H, W) weights of cells by their codes (B, H, W); see ``Losses.rare``."""
        share = torch.bincount(code.flatten(), minlength=codes).float() / code.numel()
        return share.pow(-self.losses.rare)[code]

    def _points(self, x: Tensor) -> Tensor:
        """(B, 3, H, W / 4) mean points of neighbouring cells, in units of the maximum range."""
        return F.avg_pool2d(self._metres(x) * self.rays, (1, CURVE_LENGTH))

    def _returned(self, x: Tensor) -> Tensor:
        """(B, 1, H, W) 1 where there is a return, -1 elsewhere."""
        return 2 * (self._metres(x) > 0).to(x.dtype) - 1

    def _metres(self, x: Tensor) -> Tensor:
        """(B, 1, H, W) ranges."""
        first = sum(
            CHANNELS[name] for name in self.tensors.channels[: self.tensors.channels.index("range")]
        )
        return self.tensors.normalisation.decode(x[:, first : first + 1])

    def _adversarial(
        self, judge: nn.Module, output: Tensor, x: Tensor, reconstruction: Tensor | None = None
    ) -> Tensor:
        """The terms of autoencoder and discriminator; an adaptive weight needs the loss of the
        ``reconstruction``."""
        frozen = {name: p.detach() for name, p in judge.named_parameters()}
        fooled: Tensor = -torch.func.functional_call(judge, frozen, (output,)).mean()
        verdict = F.relu(1 - judge(x)).mean() + F.relu(1 + judge(output.detach())).mean()
        balance = (
            self._balance(reconstruction, fooled)
            if self.losses.adaptive and reconstruction is not None
            else 1.0
        )
        return self.losses.adversarial * balance * fooled + verdict / 2

    def _balance(self, reconstruction: Tensor, fooled: Tensor) -> Tensor:
        """Ratio of the gradient norms of both terms at the decoder's last layer, at most 10^4."""
        assert isinstance(self.network, VQVAE)
        last = self.network.decoder.head.weight
        if not (torch.is_grad_enabled() and last.requires_grad):
            return fooled.new_zeros(())
        one, other = (
            torch.autograd.grad(x, last, retain_graph=True)[0].norm()
            for x in (reconstruction, fooled)
        )
        balance: Tensor = (one / (other + 1e-4)).clamp(max=1e4)
        return balance


def _code(bits: Tensor) -> Tensor:
    """(B, bits, H, W), -1 and 1, highest first, as codes (B, H, W)."""
    code = torch.zeros_like(bits[:, 0], dtype=torch.long)
    for bit in bits.unbind(1):
        code = 2 * code + (bit > 0)
    return code


class Discriminator(nn.Module):
    """A patch discriminator: positive outputs mean real.

    Args:
        channels: of the images.
        width: channels of the first layer; each further one has twice as many.
        depth: layers that halve the image.
    """

    def __init__(self, channels: int, width: int, depth: int = 3) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for i in range(depth):
            inputs = channels if i == 0 else width << (i - 1)
            outputs = width << i
            layers += [WrapConv(inputs, outputs, (4, 4), (2, 2), (1, 2, 1, 2))]
            layers += [Norm(outputs, 1e-6), nn.LeakyReLU(0.2)] if i else [nn.LeakyReLU(0.2)]
        self.layers = nn.Sequential(*layers, WrapConv(width << (depth - 1), 1))

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) to (B, 1, h, w)."""
        out: Tensor = self.layers(x)
        return out


def reconstruction_task(batch: Batch) -> Example:
    """The target of an image is the image itself; the noise is passed as the condition."""
    return Example(batch.y0, batch.u, batch.y0, cond=batch.y1)


def autoencoder_loss(network: nn.Module, example: Example, metric: Metric) -> Tensor:
    """The loss that ``Autoencoding`` computes itself; ``metric`` is not used."""
    loss: Tensor = network(example.y, example.cond)
    return loss


def reconstruct(codec: Latent, x: Tensor, sensor: Sensor) -> list[RangeImage]:
    """Reconstructions of tensors (B, C, H, W) as range images."""
    return codec.tensors.to_images(codec.decode(codec.encode(x)), sensor)


def reconstruction_figures(codec: Latent, x: Tensor, sensor: Sensor) -> dict[str, float]:
    """Reconstruction errors of tensors (B, C, H, W).

    Returns:
        ``mae``, metres, over cells with a return in both; ``within_5cm``, share of all real
        returns; ``drop_accuracy``, share of cells that are a return in both or in neither;
        ``chamfer``, metres, mean of both directions' mean distances to the nearest point, from up
        to 2048 points evenly spaced; with labels ``label_accuracy``, share of cells with a return
        in both whose label is the same.
    """
    rays = torch.from_numpy(sensor.ray_directions().copy())
    sums: dict[str, list[float]] = {}
    for real, made in zip(
        codec.tensors.to_images(x, sensor), reconstruct(codec, x, sensor), strict=True
    ):
        a = torch.from_numpy(real.range)
        b = torch.from_numpy(made.range)
        both = (a > 0) & (b > 0)
        error = (a - b).abs()
        figures = {
            "mae": float(error[both].mean()),
            "within_5cm": float((error[both] <= 0.05).sum() / (a > 0).sum()),
            "drop_accuracy": float(((a > 0) == (b > 0)).float().mean()),
            "chamfer": _chamfer((a[..., None] * rays)[a > 0], (b[..., None] * rays)[b > 0]),
        }
        if real.label is not None and made.label is not None:
            figures["label_accuracy"] = float((real.label == made.label)[both.numpy()].mean())
        for name, value in figures.items():
            sums.setdefault(name, []).append(value)
    return {name: sum(values) / len(values) for name, values in sums.items()}


def _chamfer(a: Tensor, b: Tensor) -> float:
    """Chamfer distance of clouds (N, 3) and (M, 3): the mean of both directions, metres."""
    if not len(a) or not len(b):
        return float("nan")
    means = []
    for some, others in ((a, b), (b, a)):
        queries = some[torch.linspace(0, len(some) - 1, min(len(some), _QUERIES)).long()]
        nearest = [torch.cdist(part, others).amin(1) for part in torch.split(queries, 64)]
        means.append(float(torch.cat(nearest).mean()))
    return sum(means) / 2
