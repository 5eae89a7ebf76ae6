"""Networks, one file per architecture. They work on tensors and ray angles and depend on no sensor
class.

To add one: write its file with a subclass of ``Network`` (or ``Encoder``), and enter the class in
``NETWORKS``. Its arguments have to be plain values, since a checkpoint stores them; its class
attributes state what a training run provides beyond them.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.modules.module import register_module_module_registration_hook

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.generate.models.efficient_unet import EfficientUNet
from lidar_synth.generate.models.encoders.calibrated_camera import SightEncoder
from lidar_synth.generate.models.encoders.camera_views import ViewEncoder
from lidar_synth.generate.models.encoders.clip_views import ClipViewEncoder
from lidar_synth.generate.models.encoders.label_maps import SemanticMapEncoder
from lidar_synth.generate.models.encoders.layouts import LayoutEncoder
from lidar_synth.generate.models.hdit.denoiser import Denoiser
from lidar_synth.generate.models.hdit.hdit import HDiT
from lidar_synth.generate.models.lidm.diffusion import DiffusionUNet
from lidar_synth.generate.models.lidm.unet import UNet
from lidar_synth.generate.models.lidm.vqvae import VQVAE
from lidar_synth.generate.models.network import Encoder, Network
from lidar_synth.generate.models.surface_codec.autoencoder import SurfaceAutoencoder

NETWORKS: dict[str, type[Network]] = {
    "hdit": HDiT,
    "denoiser": Denoiser,
    "unet": UNet,
    "diffusion_unet": DiffusionUNet,
    "efficient_unet": EfficientUNet,
    "vqvae": VQVAE,
    "surfaces": SurfaceAutoencoder,
    "semantic_map": SemanticMapEncoder,
    "layout": LayoutEncoder,
    "views": ViewEncoder,
    "clip_views": ClipViewEncoder,
    "sight": SightEncoder,
}
"""Architectures by the name that a checkpoint stores: velocity networks, autoencoders, encoders of
conditions."""


def network_class(architecture: str) -> type[Network]:
    """The class of an architecture.

    Raises:
        ConfigError: on a name that is not in ``NETWORKS``.
    """
    if not isinstance(architecture, str) or architecture not in NETWORKS:
        raise ConfigError(
            f"architecture {architecture!r}", f"one of {', '.join(NETWORKS)}"
        )
    return NETWORKS[architecture]


def encoders_of(condition: str) -> tuple[str, ...]:
    """The architectures that encode a kind of condition, in the order of ``NETWORKS``; the first is
    the default."""
    return tuple(
        k
        for k, cls in NETWORKS.items()
        if issubclass(cls, Encoder) and cls.condition == condition
    )


def build_network(architecture: str, arguments: dict[str, Any]) -> Network:
    """Build a network with fresh weights from its name and arguments.

    Args:
        architecture: a key of ``NETWORKS``.
        arguments: keyword arguments of its class.

    Raises:
        ConfigError: on an unknown name or argument, or on values that do not fit together.
    """
    cls = network_class(architecture)
    try:
        return cls(**arguments)
    except ConfigError:
        raise
    except (TypeError, ValueError, ArithmeticError, RuntimeError) as error:
        given = ", ".join(f"{name}={value!r}" for name, value in arguments.items())
        raise ConfigError(
            f"{architecture}({given})", f"the arguments of its class ({error})"
        ) from error


@contextmanager
def limit_modules(most: int) -> Iterator[None]:
    """A context in which networks of more than ``most`` modules cannot be built: the arguments in a
    file may ask for 10^9 layers.

    Raises:
        ConfigError: on more modules.
    """
    built = 0

    def count(module: nn.Module, name: str, part: nn.Module | None) -> None:
        nonlocal built
        built += 1
        if built > most:
            raise ConfigError(
                f"a network of more than {most} modules",
                "a network that its weights can fill",
            )

    hook = register_module_module_registration_hook(count)
    try:
        yield
    finally:
        hook.remove()


def assemble(
    architecture: str,
    arguments: dict[str, Any],
    state: Mapping[str, Tensor],
    what: str,
    device: torch.device | str = "cpu",
) -> nn.Module:
    """Build a network with given weights, in float32 and in evaluation mode.

    Args:
        architecture, arguments: arguments of ``build_network``.
        state: the weights by name. Tensors that are float32 on ``device`` are used without a copy.
        what: name of the weights in an error.
        device: device of the network.

    Raises:
        DataError: on invalid arguments, missing or unexpected keys, or weights of other shapes.
    """
    try:
        # On "meta", the weights that will be replaced take neither time nor memory.
        with torch.device("meta"), limit_modules(64 + 16 * len(state)):
            network = build_network(architecture, arguments)
    except ConfigError as error:
        raise DataError(f"{what}: {error}") from error
    expected = {key: tuple(value.shape) for key, value in network.state_dict().items()}
    missing = sorted(set(expected) - set(state))
    unexpected = sorted(set(state) - set(expected))
    if missing or unexpected:
        raise DataError(
            f"{what} has missing keys {missing} and unexpected keys {unexpected}",
            "exactly its own keys",
        )
    if wrong := {
        key: tuple(v.shape) for key, v in state.items() if v.shape != expected[key]
    }:
        shapes = ", ".join(
            f"{key} {shape} for {expected[key]}" for key, shape in wrong.items()
        )
        raise DataError(
            f"{what} has weights of other shapes: {shapes}",
            "the shapes that its arguments give",
        )
    network.load_state_dict(
        {key: v.to(device, torch.float32) for key, v in state.items()}, assign=True
    )
    # Convolutions would otherwise convert their weights at every call; other weights have no such
    # layout.
    return network.to(  # type: ignore[call-overload, no-any-return]
        device, memory_format=torch.channels_last
    ).eval()
