"""The state of a training run, and how it is saved for resumption.

The file is safetensors like a checkpoint, but serves to resume, not to sample: it holds the
network, the averaged weights, the optimiser's moments, the step, the seconds of training and a
checksum. Everything else is a function of the configuration and the step.
"""

import copy
import hashlib
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from lidar_synth.errors import ConfigError, DataError, FileError, choose, parsing
from lidar_synth.files.disk import write_file
from lidar_synth.generate.checkpoint import weights_hash
from lidar_synth.generate.flow.path import METRICS
from lidar_synth.geometry.normalize import CHANNELS
from lidar_synth.lab.train.optimizers import OPTIMIZERS
from lidar_synth.lab.train.schedules import SCHEDULES

STATE = "state.safetensors"
"""The file of the state in a run's folder."""


MOMENTS = ({"step", "exp_avg", "exp_avg_sq"}, {"momentum_buffer"})
"""What AdamW and Muon keep of a weight."""


LIMITS: dict[str, tuple[tuple[str, ...], Callable[[float], bool]]] = {
    "at least 1": (
        ("iterations", "batch", "accumulate", "ema_every"),
        lambda number: number >= 1,
    ),
    "above 0 (a large clip, such as 1.0e+9, does not clip)": (
        ("rate", "clip"),
        lambda number: number > 0,
    ),
    "at least 0": (
        ("warmup", "ema_after", "weight_decay"),
        lambda number: number >= 0,
    ),
    "at least 0, below 1": (("betas", "ema_decay"), lambda number: 0 <= number < 1),
}
"""{what is expected: the keys of a ``Recipe``, and whether a number of theirs fits}."""


@dataclass(frozen=True)
class Recipe:
    """The optimisation settings; the defaults are those of R2Flow's 1-RF.

    Args:
        iterations: optimiser steps in all.
        batch: samples of a step, over all processes and micro-batches.
        accumulate: micro-batches of a step.
        metric: a name of ``METRICS``.
        weights: {channel: weight} of squared errors, 1 by default. Labels are five channels of
            seven, but should not dominate the loss.
        optimizer: a name of ``OPTIMIZERS``.
        rate: the learning rate at the top of the schedule.
        betas, weight_decay: of AdamW; the weight decay also applies to Muon.
        schedule: a name of ``SCHEDULES``.
        warmup: steps until the full rate is reached.
        clip: maximum norm of the gradient; a large one, such as 1.0e+9, does not clip.
        ema_decay: decay of the averaged weights at each update; smaller in the first updates.
        ema_every: steps between these updates.
        ema_after: steps until averaging begins, up to which the averaged weights are the network's
            own; 0 = from the first step.

    Raises:
        ConfigError: on an unknown name, or a number out of its ``LIMITS``.
    """

    # Used when a configuration is validated.
    __pydantic_config__ = {"extra": "forbid"}  # noqa: RUF012

    iterations: int
    batch: int = 8
    accumulate: int = 1
    metric: str = "squared_l2"
    weights: Mapping[str, float] = field(default_factory=dict)
    optimizer: str = "adamw"
    rate: float = 1e-4
    betas: tuple[float, float] = (0.9, 0.99)
    weight_decay: float = 0.01
    schedule: str = "cosine"
    warmup: int = 10_000
    clip: float = 1.0
    ema_decay: float = 0.995
    ema_every: int = 10
    ema_after: int = 0

    def __post_init__(self) -> None:
        for key, table in (
            ("metric", METRICS),
            ("optimizer", OPTIMIZERS),
            ("schedule", SCHEDULES),
        ):
            choose(key, getattr(self, key), table)
        if set(self.weights) - set(CHANNELS) or not all(
            weight > 0 for weight in self.weights.values()
        ):
            raise ConfigError(
                f"weights {dict(self.weights)}",
                f"numbers above 0 for some of {', '.join(CHANNELS)}",
            )
        for expected, (keys, fits) in LIMITS.items():
            for key in keys:
                if not all(map(fits, np.ravel(getattr(self, key)))):
                    raise ConfigError(f"{key} {getattr(self, key)}", expected)


def kept_share(recipe: Recipe, step: int) -> float:
    """The share of the averaged weights that an update after ``step`` steps keeps.

    Early averages have a short memory, so that they forget the initial weights: it grows as in
    LiDM, or after ``ema_after`` steps as in R2Flow.
    """
    updates = step // recipe.ema_every
    share = (1 + updates) / (10 + updates)
    if recipe.ema_after:
        since = max(1, step - recipe.ema_after)
        share = 1 - since ** (-2 / 3)
    return min(recipe.ema_decay, share)


class Training:
    """The state of a run between two steps: the network, its averaged copy, the optimisers, the
    step.

    Args:
        network: the velocity network, on its device.
        recipe: the optimisation settings.
    """

    def __init__(self, network: nn.Module, recipe: Recipe) -> None:
        self.network = network
        self.recipe = recipe
        self.average = copy.deepcopy(network).eval().requires_grad_(False)
        make = OPTIMIZERS[recipe.optimizer]
        self.optimizers = make(network, recipe.rate, recipe.betas, recipe.weight_decay)
        self.step = 0
        self.earlier = 0.0
        self.began = time.monotonic()

    @property
    def seconds(self) -> float:
        """Of training, interruptions left out; ``began`` is set when the data are ready."""
        return self.earlier + time.monotonic() - self.began

    def update_average(self) -> None:
        """Move the averaged weights towards the network's, and copy its buffers (statistics of
        norms, codebooks)."""
        keep = kept_share(self.recipe, self.step)
        with torch.no_grad():
            torch._foreach_lerp_(
                list(self.average.parameters()),
                list(self.network.parameters()),
                1 - keep,
            )
            for mine, new in zip(
                self.average.buffers(), self.network.buffers(), strict=True
            ):
                mine.copy_(new)

    def save(self, path: Path) -> None:
        """Write the state beside ``path``, then rename.

        Raises:
            FileError: where it cannot be written.
        """
        write_state(path, *self.held(copy=False))

    def held(self, copy: bool) -> tuple[dict[str, str], dict[str, Tensor]]:
        """What is saved: facts, and tensors in the processor's memory; those that lie there are
        copied only if asked, and change in the next step."""
        tensors = {f"network.{n}": p for n, p in self.network.state_dict().items()}
        tensors |= {f"average.{n}": p for n, p in self.average.state_dict().items()}
        for k, optimizer in enumerate(self.optimizers):
            for i, moments in optimizer.state_dict()["state"].items():
                tensors |= {
                    f"optimizer.{k}.{i}.{n}": value for n, value in moments.items()
                }
        facts = {"step": str(self.step), "seconds": f"{self.seconds:.3f}"}
        return facts, {
            name: tensor.detach().to("cpu", copy=copy).contiguous()
            for name, tensor in tensors.items()
        }

    def load(self, path: Path) -> None:
        """Restore the state that ``save`` wrote.

        Raises:
            FileError: where the file cannot be read.
            DataError: if it is not the state of such a run.
        """
        progress, tensors = _read(path)
        parts: dict[str, dict[str, Any]] = {
            "network": {},
            "average": {},
            "optimizer": {},
        }
        with parsing(
            f"{path} is the state of another network", "the same configuration"
        ):
            for name, tensor in tensors.items():
                if tensor.is_floating_point() and not tensor.isfinite().all():
                    raise ValueError(f"{name} holds values that are not finite")
                part, key = name.split(".", 1)
                parts[part][key] = tensor
            self.network.load_state_dict(parts["network"])
            self.average.load_state_dict(parts["average"])
            moments: list[dict[int, dict[str, Tensor]]] = [{} for _ in self.optimizers]
            for name, tensor in parts["optimizer"].items():
                which, number, key = name.split(".")
                moments[int(which)].setdefault(int(number), {})[key] = tensor
            for optimizer, state in zip(self.optimizers, moments, strict=True):
                optimizer.load_state_dict(
                    {
                        "state": state,
                        "param_groups": optimizer.state_dict()["param_groups"],
                    }
                )
                _check_moments(optimizer)
                _lay_out_moments(optimizer)
        self.step, self.earlier = progress
        self.began = time.monotonic()


def write_state(path: Path, facts: dict[str, str], tensors: dict[str, Tensor]) -> None:
    """Write what ``Training.held`` returns, from where it lies in memory.

    Raises:
        FileError: where it cannot be written.
    """
    sealed = facts | {"checksum": checksum_of(facts, tensors)}

    def write(file: BinaryIO) -> None:
        try:
            save_file(tensors, file.name, sealed)
        except SafetensorError as error:  # a full disk
            raise OSError(str(error)) from error

    write_file(path, write)


def _check_moments(optimizer: torch.optim.Optimizer) -> None:
    """Refuse what torch takes here and fails on in the next step.

    Raises:
        ValueError: on moments of other names or shapes than the optimizer's own.
    """
    for parameter, moments in optimizer.state.items():
        if set(moments) not in MOMENTS:
            raise ValueError(f"a weight with {', '.join(map(str, moments))}")
        for name, value in moments.items():
            expected = () if name == "step" else tuple(parameter.shape)
            if tuple(value.shape) != expected:
                raise ValueError(
                    f"{name} of shape {tuple(value.shape)}, not {expected}"
                )


def _lay_out_moments(optimizer: torch.optim.Optimizer) -> None:
    """Give moments the strides of their weights, which fused AdamW on a GPU requires; a file holds
    them contiguous."""
    for parameter, moments in optimizer.state.items():
        for name in moments.keys() - {"step"}:
            moments[name] = torch.empty_like(parameter).copy_(moments[name])


class Progress(NamedTuple):
    """How far a saved run has come.

    Args:
        step: its last step.
        seconds: of training.
    """

    step: int = 0
    seconds: float = 0.0


def read_progress(folder: Path) -> Progress:
    """How far the run in a folder has come; nothing yet if there is no state.

    Raises:
        FileError: where the state cannot be read.
        DataError: on another file in its place.
    """
    if not (folder / STATE).exists():
        return Progress()
    with _opened(folder / STATE) as file:
        return _progress(file)


def set_damaged_aside(folder: Path) -> None:
    """Rename the state of a run if it is damaged, with a warning, so that the run begins anew.

    Raises:
        FileError: where the state cannot be read.
    """
    path = folder / STATE
    try:
        _read(path)
    except DataError as error:
        kept = path.with_suffix(".damaged")
        warnings.warn(
            f"{error}. It is kept as {kept.name}, and the run begins anew", stacklevel=2
        )
        path.replace(kept)


def _read(path: Path) -> tuple[Progress, dict[str, Tensor]]:
    """The progress and the tensors of a state, if they have the checksum that was written with
    them."""
    with _opened(path) as file:
        facts = dict(file.metadata())
        # The file is no mapping.
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        if facts.pop("checksum") != checksum_of(facts, tensors):
            raise ValueError("its checksum differs")
        return _progress(file), tensors


def checksum_of(facts: Mapping[str, str], tensors: Mapping[str, Tensor]) -> str:
    """The checksum of what is kept to resume: SHA-256, in hexadecimal."""
    return hashlib.sha256(
        f"{sorted(facts.items())} {weights_hash(tensors)}".encode()
    ).hexdigest()


def _progress(file: Any) -> Progress:
    held = file.metadata()
    return Progress(int(held["step"]), float(held["seconds"]))


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    try:
        with safe_open(path, "pt") as file:
            yield file
    except OSError as error:
        raise FileError(
            f"{path} cannot be read ({error})",
            "a saved state",
            "Start without --resume.",
        ) from error
    except (SafetensorError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise DataError(
            f"{path} is not a saved state ({error})", "state.safetensors of a run"
        ) from error
