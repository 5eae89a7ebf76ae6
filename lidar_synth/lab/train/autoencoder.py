"""Training of autoencoders, and their reconstruction errors in metres.

An autoencoder trains in the same loop as a flow: one network, one optimiser, one loss. The loss is
that of the architecture (``Autoencoder.loss``); with an adversarial term, a discriminator of
patches is trained in every step too (Esser et al., "Taming Transformers for High-Resolution Image
Synthesis", CVPR 2021).
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from typing_extensions import Self

from lidar_synth.generate.checkpoint import CODEC, Header
from lidar_synth.generate.codec import Latent
from lidar_synth.generate.flow.path import METRICS, Example, Metric
from lidar_synth.generate.models.convolution import Norm, WrapConv
from lidar_synth.generate.models.network import Autoencoder
from lidar_synth.generate.models.objective import Losses, Objective
from lidar_synth.geometry import RangeImage, Sensor
from lidar_synth.geometry.normalize import TensorFormat
from lidar_synth.lab.train.config import TrainConfig
from lidar_synth.lab.train.data import Batch, Batches
from lidar_synth.lab.train.stage import Stage, Task
from lidar_synth.lab.train.start import open_networks

MEASURED = 8
"""Scans on which the noise of cells is measured."""

_QUERIES = 2048  # points whose nearest neighbours are searched


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
        network: Autoencoder,
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
        self.discriminator = None
        if losses.adversarial:
            self.discriminator = Discriminator(tensors.size, losses.discriminator_width)
        directions = torch.from_numpy(sensor.ray_directions().copy()).movedim(-1, 0)
        self.register_buffer("rays", directions / sensor.range_max, persistent=False)

    @classmethod
    def of(cls, config: TrainConfig, network: nn.Module, header: Header) -> Self:
        """The module of a configuration."""
        made: Any = network
        metric = METRICS[config.recipe.metric]
        weights = config.recipe.weights
        return cls(made, header.tensors, header.sensor, config.losses, metric, weights)

    @property
    def objective(self) -> Objective:
        """What the autoencoder is trained for."""
        return Objective(
            self.tensors,
            self.rays,
            self.losses,
            self.metric,
            self.weights,
            self.discriminator,
        )

    def forward(self, x: Tensor, noise: Tensor | None = None) -> Tensor:
        """The loss of a batch of tensors (B, C, H, W), a scalar; ``noise`` is standard normal, of
        the same shape."""
        noise = torch.zeros_like(x) if noise is None else noise
        return self.network.loss(x, noise, self.objective)

    def finish(self, data: Batches) -> None:
        """Set what is not trained but measured, on the first scans."""
        images = (data(range(i, i + 1)).y0 for i in range(MEASURED))
        self.network.measure(images, self.objective)


class Discriminator(nn.Module):
    """A patch discriminator: positive outputs mean real.

    Args:
        channels: of the images.
        width: channels of the first layer; each further one has twice as many.
    """

    def __init__(self, channels: int, width: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for i in range(3):
            inputs = channels if i == 0 else width << (i - 1)
            outputs = width << i
            layers.append(WrapConv(inputs, outputs, (4, 4), (2, 2), (1, 2, 1, 2)))
            if i:
                layers.append(Norm(outputs, 1e-6))
            layers.append(nn.LeakyReLU(0.2))
        self.layers = nn.Sequential(*layers, WrapConv(4 * width, 1))

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


class AutoencoderStage(Stage):
    """The training of an autoencoder; raises as ``open_networks``."""

    task: Task = staticmethod(reconstruction_task)
    loss = staticmethod(autoencoder_loss)

    def __init__(self, config: TrainConfig, device: torch.device | str) -> None:
        networks, header = open_networks(config)
        trained = Autoencoding.of(config, networks[CODEC], header)
        super().__init__(config, trained, header, {}, device)

    def finish(self, network: Any, data: Batches) -> None:
        """Measure the noise of cells."""
        network.finish(data)

    def parts(self, network: Any) -> dict[str, nn.Module]:
        """The autoencoder, and what stands still."""
        return {CODEC: network.network, **self.frozen}

    def figures(self, network: Any, data: Batches, count: int) -> dict[str, float]:
        """Errors of the first scans' reconstructions."""
        codec = Latent(network.network, self.header.tensors)
        x = data(range(count)).y0
        found = reconstruction_figures(codec, x, self.header.sensor)
        return {f"reconstruction/{name}": value for name, value in found.items()}

    def samples(self, network: Any, data: Batches, count: int) -> Sequence[RangeImage]:
        """The first scans, each followed by its reconstruction."""
        codec = Latent(network.network, self.header.tensors)
        x = data(range(count)).y0
        sensor = self.header.sensor
        shown: list[RangeImage] = []
        for real, made in _pairs(codec, x, sensor):
            shown += [real, made]
        return shown


def reconstruct(codec: Latent, x: Tensor, sensor: Sensor) -> list[RangeImage]:
    """Reconstructions of tensors (B, C, H, W) as range images."""
    return codec.tensors.to_images(codec.decode(codec.encode(x)), sensor)


def _pairs(
    codec: Latent, x: Tensor, sensor: Sensor
) -> Iterable[tuple[RangeImage, RangeImage]]:
    """Range images with their reconstructions."""
    real = codec.tensors.to_images(x, sensor)
    return zip(real, reconstruct(codec, x, sensor), strict=True)


def reconstruction_figures(
    codec: Latent, x: Tensor, sensor: Sensor
) -> dict[str, float]:
    """Reconstruction errors of tensors (B, C, H, W).

    Returns:
        ``mae``, metres, over cells with a return in both; ``within_5cm``, share of all real
        returns; ``drop_accuracy``, share of cells that are a return in both or in neither;
        ``chamfer``, metres, mean of both directions' mean distances to the nearest point, from up
        to 2048 points evenly spaced; with labels ``label_accuracy``, share of cells with a return
        in both whose label is the same.
    """
    rows = [_compare(real, made) for real, made in _pairs(codec, x, sensor)]
    names = dict.fromkeys(name for row in rows for name in row)
    means = {}
    for name in names:
        values = [row[name] for row in rows if name in row]
        means[name] = sum(values) / len(values)
    return means


def _compare(real: RangeImage, made: RangeImage) -> dict[str, float]:
    """The errors of one image."""
    a = torch.from_numpy(real.range)
    b = torch.from_numpy(made.range)
    both = (a > 0) & (b > 0)
    error = (a - b).abs()
    figures = {
        "mae": float(error[both].mean()),
        "within_5cm": float((error[both] <= 0.05).sum() / (a > 0).sum()),
        "drop_accuracy": float(((a > 0) == (b > 0)).float().mean()),
        "chamfer": _chamfer(_points(real), _points(made)),
    }
    if real.label is not None and made.label is not None:
        same = real.label == made.label
        figures["label_accuracy"] = float(same[both.numpy()].mean())
    return figures


def _points(image: RangeImage) -> Tensor:
    """(N, 3) points of the returns."""
    directions = image.sensor.ray_directions()[image.mask]
    return torch.from_numpy(image.range[image.mask][:, None] * directions)


def _chamfer(a: Tensor, b: Tensor) -> float:
    """Chamfer distance of clouds (N, 3) and (M, 3): the mean of both directions, metres."""
    if not len(a) or not len(b):
        return float("nan")
    return (_distance(a, b) + _distance(b, a)) / 2


def _distance(some: Tensor, others: Tensor) -> float:
    """Mean distance of points to the nearest other one."""
    count = min(len(some), _QUERIES)
    queries = some[torch.linspace(0, len(some) - 1, count).long()]
    nearest = [torch.cdist(part, others).amin(1) for part in torch.split(queries, 64)]
    return float(torch.cat(nearest).mean())
