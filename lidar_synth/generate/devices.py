"""The devices that torch can compute on here."""

import torch

from lidar_synth.errors import ConfigError


def available_devices() -> list[str]:
    """Names of the devices that are there: "cpu" first, then each GPU, then "mps" on a Mac that has it."""
    names = ["cpu"]
    for kind in ("cuda", "xpu"):
        module = getattr(torch, kind)
        names += [f"{kind}:{i}" for i in range(module.device_count())] if module.is_available() else []
    return [*names, "mps"] if torch.backends.mps.is_available() else names


def checked_device(device: str | torch.device) -> torch.device:
    """The device of a name; a kind without a number is the current device of that kind.

    Raises:
        ConfigError: on a name that is no device, or a device that is not there; it lists those that are.
    """
    try:
        given = torch.device(device)
    except (RuntimeError, TypeError) as error:  # torch knows no such word, or it is no word
        raise _missing(device, available_devices()) from error
    if given.type == "cpu" and not given.index:
        return given  # without a look at the GPUs: a process that has looked cannot fork children that use them
    there = available_devices()
    kinds = {name.partition(":")[0] for name in there}
    if str(given) not in there and (given.type not in kinds or given.index is not None):
        raise _missing(device, there)
    return given


def _missing(device: object, there: list[str]) -> ConfigError:
    hint = "A GPU needs a build of torch for it and its driver: `lidar-synth doctor` says what is there."
    return ConfigError(f"device {str(device)!r}", f"one that torch finds here: {', '.join(there)}", hint)
