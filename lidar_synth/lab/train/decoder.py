"""Fine-tuning of a decoder on the latents that a flow generates.

An autoencoder is trained on its own latents with a little noise. A student of few steps makes
larger errors of another kind, such as walls whose pieces do not meet. Therefore the decoder alone
is trained further, with encoder and flow frozen. Every other latent is noised to the student's last
timestep and denoised by the student's last step; the decoder learns to reconstruct the original
scan from it. The other latents get noise of random strength up to that of ``Losses``, so that the
decoder still trusts exact latents.
"""

import math

import torch
from torch import Tensor, nn

from lidar_synth.errors import ConfigError
from lidar_synth.generate.checkpoint import CODEC, join
from lidar_synth.generate.flow.path import Example, Metric, Velocity, interpolate
from lidar_synth.generate.flow.solvers import mean_velocity
from lidar_synth.generate.models.bounded_latent import BoundedAutoencoder
from lidar_synth.lab.train.autoencoder import AutoencoderStage, Autoencoding
from lidar_synth.lab.train.config import TrainConfig
from lidar_synth.lab.train.data import Batch
from lidar_synth.lab.train.stage import Stage, Task
from lidar_synth.lab.train.start import open_networks


class Decoding(Autoencoding):
    """The trained module: a decoder; the encoder is frozen. Takes the arguments of
    ``Autoencoding``."""

    network: BoundedAutoencoder

    # It does not make its latents.
    def forward(self, z: Tensor, x: Tensor) -> Tensor:  # type: ignore[override]
        """The loss of images (B, C, H, W) under what latents (B, *latent_shape) say, a scalar."""
        return self.network.decoder_loss(z, x, self.objective)


def decoding_loss(network: nn.Module, example: Example, metric: Metric) -> Tensor:
    """The loss of ``Decoding``, which knows its metric itself."""
    loss: Tensor = network(example.y, example.velocity)
    return loss


def decoding_task(
    autoencoder: BoundedAutoencoder, velocity: Velocity, time: float, noise: float
) -> Task:
    """Latents as a flow leaves them; the answer is the image.

    Args:
        autoencoder: of the latents, standing still.
        velocity: of the flow.
        time: where its last step begins.
        noise: of ``Losses``.
    """
    shape = autoencoder.latent_shape

    @torch.no_grad()
    def task(batch: Batch) -> Example:
        z = autoencoder.encode(batch.y0)
        some = batch.y1.flatten(1)[:, : math.prod(shape)].reshape(-1, *shape)
        u = batch.u.view(-1, 1, 1, 1)
        t = torch.full_like(batch.u, time)
        y = interpolate(z, some, t)
        left = y - time * velocity(y, t, batch.cond).float()
        strength = (2 * u - 1).clamp_min(0) * noise
        shaken = z + strength * some / autoencoder.scale.view(1, -1, 1, 1)
        return Example(torch.where(u < 0.5, left, shaken), batch.u, batch.y0)

    return task


class DecoderStage(AutoencoderStage):
    """The training of the decoder of a latent model, ``config.init``.

    Raises:
        ConfigError: on a model without such a decoder.
    """

    loss = staticmethod(decoding_loss)

    def __init__(self, config: TrainConfig, device: torch.device | str) -> None:
        networks, header = open_networks(config)
        network = networks.pop(CODEC)
        if not isinstance(network, BoundedAutoencoder):
            raise ConfigError(
                f"decoder with init {config.init}",
                "a model whose autoencoder predicts distributions",
            )
        for weight in network.encoder():
            weight.requires_grad_(False)
        trained = Decoding.of(config, network, header)
        Stage.__init__(self, config, trained, header, networks, device)
        velocity = mean_velocity(join(self.frozen), header.time_grid)
        self.task = decoding_task(
            network, velocity, header.time_grid[-2], config.losses.noise
        )
