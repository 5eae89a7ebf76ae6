"""A new network is one class and one line in ``NETWORKS``: training, saving, loading and sampling
follow."""

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

import pytest
import torch
from latent_runs import SEMANTIC, call, one_thread, scans, write_config  # noqa: F401 - fixtures
from torch import Tensor, nn

from lidar_synth.errors import ConfigError
from lidar_synth.generate.checkpoint import CODEC, ENCODER, VELOCITY, load_checkpoint
from lidar_synth.generate.loading import load_generator
from lidar_synth.generate.models import NETWORKS, encoders_of, network_class
from lidar_synth.generate.models.network import Autoencoder, Encoder, Network
from lidar_synth.generate.models.objective import Objective


class PointwiseFlow(Network):
    """A velocity network of one 1 x 1 convolution over the state, the rays' elevations and the
    condition."""

    needs_ray_angles: ClassVar[bool] = True

    def __init__(
        self,
        resolution: Sequence[int],
        channels: int,
        condition_channels: int = 0,
        angles: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.channels = channels
        self.resolution = tuple(resolution)
        self.mix = nn.Conv2d(channels + 1 + condition_channels, channels, 1)
        self.register_buffer(
            "angles", torch.zeros(2, *resolution) if angles is None else angles.float()
        )

    def forward(self, y: Tensor, t: Tensor, cond: Tensor | None = None) -> Tensor:
        elevation = self.angles[:1].expand(len(y), 1, *y.shape[2:])
        return self.mix(torch.cat([y, elevation] + ([] if cond is None else [cond]), 1))


class PointwiseCodec(Autoencoder):
    """An autoencoder whose latents are the image's own cells, mixed; it takes the name of the
    normalisation."""

    derived_arguments: ClassVar[tuple[str, ...]] = (
        "resolution",
        "channels",
        "normalisation",
    )

    def __init__(
        self, resolution: Sequence[int], channels: int, normalisation: str
    ) -> None:
        super().__init__()
        self.channels = channels
        self.resolution = tuple(resolution)
        self.draws = 0
        self.latent_shape = (channels, *resolution)
        self.normalisation = normalisation
        self.encoder = nn.Conv2d(channels, channels, 1)
        self.decoder = nn.Conv2d(channels, channels, 1)

    def encode(self, x: Tensor) -> Tensor:
        return self.encoder(x)

    def decode(self, z: Tensor, uniform_noise: Tensor | None = None) -> Tensor:
        return self.decoder(z)

    def loss(self, x: Tensor, noise: Tensor, objective: Objective) -> Tensor:
        return objective.reconstruction(self.decode(self.encode(x)), x)


class ClassPresence(Encoder):
    """An encoder of label maps: one map that is 1 where the label is known."""

    derived_arguments: ClassVar[tuple[str, ...]] = ("resolution",)
    condition: ClassVar[str] = "semantic"
    argument: ClassVar[str] = "condition_channels"

    def __init__(self, resolution: Sequence[int]) -> None:
        super().__init__()
        self.resolution = tuple(resolution)
        self.channels = 1
        self.gain = nn.Parameter(torch.ones(()))

    def forward(self, labels: Tensor) -> Tensor:
        return self.gain * (labels != 255).to(self.gain.dtype)[:, None]


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, cls in (
        ("pointwise", PointwiseFlow),
        ("cells", PointwiseCodec),
        ("presence", ClassPresence),
    ):
        monkeypatch.setitem(NETWORKS, name, cls)


def test_a_new_velocity_network_with_a_new_encoder_is_trained_saved_and_sampled(
    scans: Path, tmp_path: Path
) -> None:
    condition = {"kind": "semantic", "encoder": "presence", "dropout": 0.1}
    assert "presence" in encoders_of("semantic")
    config = write_config(
        scans,
        tmp_path,
        "flow",
        network={"architecture": "pointwise"},
        condition=condition,
        steps=2,
    )
    call("train", config)
    checkpoint = load_checkpoint(tmp_path / "flow" / "flow.safetensors")
    assert isinstance(checkpoint.networks[VELOCITY], PointwiseFlow)
    assert isinstance(checkpoint.networks[ENCODER], ClassPresence)
    angles = torch.from_numpy(checkpoint.header.sensor.ray_angles())
    torch.testing.assert_close(checkpoint.networks[VELOCITY].angles, angles.float())
    generator = load_generator(tmp_path / "flow" / "flow.safetensors")
    [image] = generator.range_images(0, [0], torch.zeros(8, 32, dtype=torch.uint8))
    assert image.range.shape == (8, 32)


def test_a_new_autoencoder_is_trained_saved_and_used_by_a_latent_model(
    scans: Path, tmp_path: Path
) -> None:
    call(
        "train",
        write_config(scans, tmp_path, "codec", network={"architecture": "cells"}),
    )
    codec = tmp_path / "codec" / "codec.safetensors"
    assert load_checkpoint(codec).networks[CODEC].normalisation == "r2flow"
    call(
        "train",
        write_config(
            scans,
            tmp_path,
            "latent",
            network={"architecture": "pointwise"},
            codec=str(codec),
        ),
    )
    [scan] = load_generator(tmp_path / "latent" / "latent.safetensors").scans(
        0, [0], steps=2
    )
    assert scan.label is not None


def test_an_argument_that_follows_from_the_run_cannot_be_set_again(
    scans: Path, tmp_path: Path
) -> None:
    network = {"architecture": "cells", "arguments": {"normalisation": "lidm"}}
    with pytest.raises(
        ConfigError, match=r"network.arguments with \['normalisation'\]"
    ):
        call("train", write_config(scans, tmp_path, "codec", network=network))


def test_an_unknown_architecture_is_named_with_the_known_ones(
    scans: Path, tmp_path: Path
) -> None:
    with pytest.raises(
        ConfigError, match="architecture 'resnet'; expected one of hdit, denoiser, unet"
    ):
        network_class("resnet")
    with pytest.raises(
        ConfigError, match="architecture 'resnet'; expected one of hdit"
    ):
        call(
            "train",
            write_config(scans, tmp_path, "flow", network={"architecture": "resnet"}),
        )
    with pytest.raises(
        ConfigError,
        match=r"condition.encoder 'views'; expected one of 'semantic_map', 'presence'",
    ):
        call(
            "train",
            write_config(
                scans, tmp_path, "flow", condition=SEMANTIC | {"encoder": "views"}
            ),
        )
