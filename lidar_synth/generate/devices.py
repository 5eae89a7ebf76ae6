"""The devices that torch can compute on."""

import torch

from lidar_synth.errors import ConfigError


def available_devices() -> list[str]:
    """Names of the available devices: "cpu" first, then each GPU, then "mps" if a Mac has it."""
    names = ["cpu"]
    for kind in ("cuda", "xpu"):
        module = getattr(torch, kind)
        names += [f"{kind}:{i}" for i in range(module.device_count())] if module.is_available() else []
    return [*names, "mps"] if torch.backends.mps.is_available() else names


def checked_device(device: str | torch.device) -> torch.device:
    """The device with a name; a type without an index is the current device of that type.

    Raises:
        ConfigError: on an unknown name or an unavailable device; the message lists the available ones.
    """
    try:
        given = torch.device(device)
    except (RuntimeError, TypeError) as error:  # an unknown name, or not a string
        raise _missing(device, available_devices()) from error
    if given.type == "cpu" and not given.index:
        return given  # without querying GPUs: after CUDA is initialised, forked children cannot use it
    available = available_devices()
    kinds = {name.partition(":")[0] for name in available}
    if str(given) not in available and (given.type not in kinds or given.index is not None):
        raise _missing(device, available)
    return given


def _missing(device: object, available: list[str]) -> ConfigError:
    hint = "A GPU needs its driver and a build of torch that supports it; `lidar-synth doctor` shows what is installed."
    return ConfigError(f"device {str(device)!r}", f"an available one: {', '.join(available)}", hint)
