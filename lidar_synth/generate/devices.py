"""The devices that torch can compute on."""

from contextlib import AbstractContextManager

import torch
from torch.utils.data import get_worker_info

from lidar_synth.errors import ConfigError

DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16}
"""Data types of a network's computation, by name."""


def available_devices() -> list[str]:
    """Names of the available devices: "cpu" first, then each GPU, then "mps" if a Mac has it."""
    names = ["cpu"]
    for kind in ("cuda", "xpu"):
        module = getattr(torch, kind)
        if module.is_available():
            names += [f"{kind}:{i}" for i in range(module.device_count())]
    return [*names, "mps"] if torch.backends.mps.is_available() else names


def check_device(device: str | torch.device) -> torch.device:
    """The device with a name; a type without an index is the current device of that type.

    Raises:
        ConfigError: on an unknown name or an unavailable device; the message lists the available
            ones.
    """
    try:
        wanted = torch.device(device)
    except (RuntimeError, TypeError) as error:  # an unknown name, or not a string
        raise _missing(device, available_devices()) from error
    if wanted.type == "cpu" and not wanted.index:
        # Without querying GPUs: after CUDA is initialised, forked children cannot use it.
        return wanted
    available = available_devices()
    if not any(str(wanted) in (name, name.partition(":")[0]) for name in available):
        raise _missing(device, available)
    return wanted


def _missing(device: object, available: list[str]) -> ConfigError:
    return ConfigError(
        f"device {str(device)!r}",
        f"an available one: {', '.join(available)}",
        "A GPU needs its driver and a build of torch that supports it; `lidar-synth doctor` shows "
        "what is installed.",
    )


def refuse_worker(device: torch.device | str) -> None:
    """Refuse a GPU in DataLoader workers: a forked process cannot use it, and each spawned one
    would need a context."""
    on_cpu = str(device).startswith(("cpu", "meta"))
    if not on_cpu and get_worker_info() is not None:
        raise ConfigError(
            "a generator on the GPU inside a DataLoader worker",
            "one of three ways: (A) bake a bank first and read it in the workers, (B) a rolling "
            "bank, (C) mix in the main process, on the training device",
            "On the CPU, load_generator(..., device='cpu') works in workers too.",
        )


def without_autocast(device: torch.device) -> AbstractContextManager[None]:
    """A context without the caller's ``torch.autocast``, which would change the scans of a
    generator."""
    # torch 2.4 has no autocast for "mps".
    kind = device.type if torch.amp.is_autocast_available(device.type) else "cpu"
    return torch.autocast(kind, enabled=False)
