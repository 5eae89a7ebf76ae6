"""Loading of generators: shipped models by name, checkpoints by path."""

from pathlib import Path
from typing import Any

import torch
from torch import nn

from lidar_synth.errors import ConfigError, DataError, suggest
from lidar_synth.files.hub import fetch_model, is_on_hub, pin_model, shipped_models
from lidar_synth.generate.checkpoint import (
    CODEC,
    VELOCITY,
    join,
    load_checkpoint,
)
from lidar_synth.generate.devices import check_device, refuse_worker
from lidar_synth.generate.generator import BATCH, Generator


def load_generator(
    model: str | Path,
    *,
    device: str | torch.device = "cpu",
    dtype: torch.dtype = torch.float32,
    compile: bool = False,
    batch: int | None = None,
    columns: int | None = None,
) -> Generator:
    """Load a generator from a shipped model or a checkpoint file.

    Args:
        model: a shipped model's name ("town"), a path to a ``.safetensors`` checkpoint, or a model
            on the Hugging Face hub: ``hf://user/model``, with ``@REVISION`` for one of its commits.
        device: an available device such as "cpu", "cuda" or "cuda:1"; see ``available_devices``.
        dtype: dtype of the network's computations; states stay float32.
        compile: whether to compile the velocity network and the decoder of a latent model with
            ``torch.compile``; the first scan then takes long.
        batch: number of scans computed at a time; by default it depends on the device.
        columns: number of columns of the scans; a model of 2,048 columns can also generate 1,024,
            at about half of the decoder's cost.

    Raises:
        ConfigError: on an unknown name, an unavailable device, a GPU in a DataLoader worker, a
            ``dtype`` that is no floating-point type of torch, a batch below 1, or a number of
            columns that the model cannot generate.
        FileError, DataError: if the checkpoint cannot be read, or a shipped one is damaged.
        LibraryError: on a model on the hub without the extra ``hub``.

    Example:
        >>> from lidar_synth import load_generator
        >>> generator = load_generator("town")
        >>> first, second = generator.scans(seed=0, indices=[0, 1])
        >>> second.id, sorted(second.fields())
        ('town/0/1', ['confidence', 'label', 'reflectance'])
    """
    if not isinstance(dtype, torch.dtype) or not dtype.is_floating_point:
        raise ConfigError(f"dtype={dtype!r}", "a floating-point type: torch.float16")
    refuse_worker(device)
    device = check_device(device)
    path = find_model(model)
    header, networks, digest = load_checkpoint(path, device)
    if VELOCITY not in networks:
        raise DataError(
            f"{path} is an autoencoder",
            "a model that generates",
            f"Train one with codec={path}.",
        )
    for network in networks.values():
        network.to(dtype).requires_grad_(False)
    if compile:
        _compile(networks)
    size = BATCH.get(device.type, 1) if batch is None else batch
    return Generator(
        path.stem,
        join(networks),
        header,
        digest,
        size,
        networks.get(CODEC),
        columns,
        path,
    )


def _compile(networks: dict[str, nn.Module]) -> None:
    """Compile the velocity network and the decoder, in place."""
    networks[VELOCITY].compile()
    if CODEC in networks:
        # ``Module.compile`` compiles ``forward``, but a codec is called by ``decode``. Compiled for
        # two widths at once, it gives infinite values (torch 2.13).
        codec: Any = networks[CODEC]
        codec.decode = torch.compile(codec.decode, dynamic=False)


def find_model(model: str | Path) -> Path:
    """The checkpoint file of a shipped model or of one on the hub, or the given path itself.

    Raises:
        ConfigError: on an unknown name.
        FileError, DataError, LibraryError: as ``hub.fetch_model``.
    """
    if is_on_hub(model):
        return fetch_model(str(model))
    shipped = shipped_models()
    path = shipped.get(str(model), Path(model))
    if path.suffix != ".safetensors":
        names = ", ".join(shipped) or "none in this installation"
        raise ConfigError(
            f"model {str(model)!r}",
            f"a shipped one ({names}), a .safetensors file or hf://user/model",
            suggest(model, shipped),
        )
    return path


def settle_model(model: str) -> str:
    """The name by which a model is found from any folder and at any time: that of a shipped one, an
    absolute path, or a commit of the hub.

    Raises:
        FileError, LibraryError: as ``hub.pin_model``.
    """
    if is_on_hub(model):
        return pin_model(model)
    path = Path(model)
    return str(path.resolve()) if path.suffix == ".safetensors" else model
