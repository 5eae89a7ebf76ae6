"""Shared by the launchers: the script on the command line, and a trial of a trainer on a machine
without a GPU.

Without a GPU, or with ``LIDAR_SYNTH_CPU=1``, what a trainer sends to a GPU stays on the CPU. This
shows whether a configuration runs; it is too slow for training.
"""

import logging
import os
import runpy
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import Any

import torch
from lidar_synth.integrations.removed import provide
from torch.nn import functional

from lidar_synth.errors import LidarSynthError

CPU = "LIDAR_SYNTH_CPU"
"""Environment variable: 1 keeps on the CPU what a trainer sends to a GPU, also where there is one;
0 does not."""


def prepare_script(usage: str, *names: str) -> str:
    """Take the trainer's script from the command line, as Python would, and set the removed names
    that it uses.

    Args:
        usage: a command, shown when there is no script.
        names: keys of ``removed.NAMES``.

    Returns:
        The script's path, now ``sys.argv[0]``; its folder is first on the path.

    Raises:
        SystemExit: without a script.
        LibraryError: if a library is missing.
    """
    if len(sys.argv) < 2 or not Path(sys.argv[1]).is_file():
        print(f"usage: {usage}", file=sys.stderr)
        raise SystemExit(2)
    sys.argv = sys.argv[1:]
    sys.path.insert(0, str(Path(sys.argv[0]).resolve().parent))
    say_epochs()
    provide(*names)
    if os.environ.setdefault(CPU, str(int(not torch.cuda.is_available()))) == "1":
        stay_on_cpu()
    return sys.argv[0]


def say_epochs() -> None:
    """Print the package's own messages, one line for each epoch's mixture among them."""
    handler = logging.StreamHandler(sys.stdout)
    handler.setFormatter(logging.Formatter("lidar_synth: %(message)s"))
    log = logging.getLogger("lidar_synth")
    log.addHandler(handler)
    log.setLevel(logging.INFO)


def run(script: str) -> None:
    """Run a script as ``python SCRIPT`` does, with the arguments that are left."""
    with plain_errors():
        runpy.run_path(script, run_name="__main__")


@contextmanager
def plain_errors() -> Iterator[None]:
    """On an error of this package, exit with status 1 and its message instead of a traceback."""
    try:
        yield
    except LidarSynthError as error:
        raise SystemExit(f"lidar_synth: {error}") from None


def stay_on_cpu() -> None:
    """Keep on the CPU what is sent to a GPU; class targets become int64, as these trainers make
    them on a GPU."""
    print(
        f"lidar_synth: no GPU, or {CPU}=1: what this trainer sends to a GPU stays on the CPU",
        flush=True,
    )
    changed: dict[tuple[Any, str], Any] = {
        (torch.cuda, "set_device"): lambda device: None,
        (torch.Tensor, "get_device"): lambda self: self.device,
        (torch, "load"): _loading_to_cpu(torch.load),
        (torch, "eye"): _on_default_device(torch.eye),
        (functional, "nll_loss"): _int64(functional.nll_loss),
    }
    for kind in (torch.Tensor, torch.nn.Module):
        changed[kind, "cuda"] = lambda self, *args, **options: self
        changed[kind, "to"] = _without_gpu(kind.to)
    for (owner, name), new in changed.items():
        setattr(owner, name, new)
    if "spconv.pytorch" in sys.modules:
        sparse = sys.modules["spconv.pytorch"]
        sparse.ops.get_current_stream = lambda: 0  # a CPU has no stream
        layer = sparse.conv.SparseConvolution
        layer._conv_forward = _bias_after(layer._conv_forward)


def _on_gpu(device: Any) -> bool:
    return isinstance(device, str | torch.device) and str(device).startswith("cuda")


def _int64(loss: Any) -> Any:
    """A loss that takes class targets of any integer type."""

    @wraps(loss)
    def changed(values: Any, target: Any, *args: Any, **options: Any) -> Any:
        return loss(values, target.long(), *args, **options)

    return changed


def _bias_after(forward: Any) -> Any:
    """spconv's forward in training mode, which adds the bias after the convolution; in evaluation
    mode it does so within it, which needs a GPU."""

    @wraps(forward)
    def changed(self: Any, training: bool, *args: Any, **options: Any) -> Any:
        return forward(self, True, *args, **options)

    return changed


def _without_gpu(move: Any) -> Any:
    """The method ``to`` that leaves out a GPU."""

    @wraps(move)
    def moved(self: Any, *args: Any, **options: Any) -> Any:
        left = [value for value in args if not _on_gpu(value)]
        named = {key: value for key, value in options.items() if not _on_gpu(value)}
        if left or set(named) - {"non_blocking"}:
            return move(self, *left, **named)
        return self

    return moved


def _on_default_device(make: Any) -> Any:
    """A function that makes a tensor, without a GPU as its device."""

    @wraps(make)
    def changed(*args: Any, **options: Any) -> Any:
        kept = {key: value for key, value in options.items() if not _on_gpu(value)}
        return make(*args, **kept)

    return changed


def _loading_to_cpu(load: Any) -> Any:
    """``torch.load`` that maps a GPU to the CPU."""

    @wraps(load)
    def loaded(*args: Any, **options: Any) -> Any:
        if _on_gpu(options.get("map_location")):
            options["map_location"] = "cpu"
        return load(*args, **options)

    return loaded
