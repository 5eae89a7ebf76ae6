"""Configuration files of training runs: YAML in, checked values out.

The models hold all defaults. A key that no model knows is refused with the keys that are known; what a run needs is
built from the values by the caller, so that nothing below knows of configurations.
"""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import torch
import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from lidar_synth.errors import ConfigError, FileError
from lidar_synth.formats import open_scans
from lidar_synth.nets import build_network
from lidar_synth.normalize import NORMALISATIONS, TensorFormat
from lidar_synth.scan import Source
from lidar_synth.sensor import Sensor, load_sensor
from lidar_synth.town.town import Town
from lidar_synth.train import Recipe

Count = Annotated[int, Field(ge=1)]


class Section(BaseModel):
    """A part of a configuration; unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Data(Section):
    """Where the scans come from: the town, or a path.

    Args:
        licence: of the scans; it will stand in the checkpoint.
        town: so many scans of the embedded town.
        seed: of the town.
        interval: seconds between neighbouring scans of the town.
        path: a dataset's root, a folder or a file; environment variables are filled in.
        layout, split: of the path, as ``open_scans`` takes them.
        on_bad: "error", or "skip" to leave out scans that cannot be read.
        cache: folder of the projected scans; by default ``cache`` beside the run's output.
        flip: mirror every other sample.
        roll: turn every sample by a random number of columns.
    """

    licence: str
    town: Count | None = None
    seed: Annotated[int, Field(ge=0)] = 0
    interval: float = 1.0
    path: str | None = None
    layout: str | None = None
    split: str | None = None
    on_bad: Literal["error", "skip"] = "error"
    cache: Path | None = None
    flip: bool = False
    roll: bool = False

    def open(self, sensor: Sensor) -> Source:
        """The scans.

        Raises:
            ConfigError: on a path with a variable that is not set, or what the source refuses.
        """
        if self.town is not None:
            return Town(self.seed, sensor, self.town, self.interval)
        path = os.path.expandvars(self.path or "")
        if "$" in path:
            raise ConfigError(f"data.path {self.path!r}", "variables that are set", "Or give data.path=FOLDER.")
        return open_scans(path, layout=self.layout, split=self.split, on_bad=self.on_bad)

    def describe(self) -> dict[str, Any]:
        """What tells these scans from others, plain values."""
        keys = {"seed", "interval"} if self.path else {"path", "layout", "split", "on_bad"}
        return self.model_dump(mode="json", exclude=keys | {"cache", "flip", "roll"})


class Samples(Section):
    """Pictures while a run goes on.

    Args:
        every: iterations between two; 0 = none.
        count: scans in each, always from the same noise.
    """

    every: Annotated[int, Field(ge=0)] = 5000
    count: Count = 8


class Run(Section):
    """What teacher and student have in common.

    Args:
        output: folder of the run; its last part names the checkpoint.
        licence: of the weights; it will stand in the checkpoint.
        data: the scans.
        recipe: how the weights are moved.
        seed: of the data's order, the noise and the times.
        precision: "no" = float32, or "bf16".
        compile: by ``torch.compile``.
        gradient_checkpointing: less memory, more time.
        save_every: iterations between two saves.
        samples: pictures.
    """

    output: Path
    licence: str
    data: Data
    recipe: Recipe
    seed: Annotated[int, Field(ge=0, lt=2**62)] = 0
    precision: Literal["no", "bf16"] = "no"
    compile: bool = False
    gradient_checkpointing: bool = False
    save_every: Count = 1000
    samples: Samples = Samples()


class Network(Section):
    """Architecture (a name of ``NETWORKS``) and its arguments, without resolution and channels, which follow."""

    architecture: str = "hdit"
    arguments: dict[str, Any] = {}


class TrainConfig(Run):
    """A teacher: a rectified flow from noise to scans.

    Args:
        sensor: a preset's name or a YAML file.
        channels: of the tensor, in order.
        normalisation: a name of ``NORMALISATIONS``.
        rays: through the cells' centres or, as the peers have it, their corners: the angles that the network sees.
        network: what to train.
        init: checkpoint to start from; its network, sensor, channels and normalisation are those of the run then.
        timesteps: a name of ``TIMESTEPS``.
        steps: of the uniform time grid that the checkpoint names.
    """

    sensor: str = "hdl64e_kitti360"
    channels: tuple[str, ...] = ("range", "reflectance")
    normalisation: str = "r2flow"
    rays: Literal["centre", "corner"] = "centre"
    network: Network = Network()
    init: Path | None = None
    timesteps: Literal["uniform", "u_shaped", "logit_normal"] = "uniform"
    steps: Count = 50

    def tensors(self) -> TensorFormat:
        """Layout of the network's tensors.

        Raises:
            ConfigError: on an unknown channel or normalisation.
        """
        if self.normalisation not in NORMALISATIONS:
            raise ConfigError(f"normalisation {self.normalisation!r}", f"one of {', '.join(NORMALISATIONS)}")
        return TensorFormat(self.channels, NORMALISATIONS[self.normalisation])

    def network_arguments(self) -> dict[str, Any]:
        """All plain arguments of the network."""
        given = {"resolution": load_sensor(self.sensor).shape, "channels": self.tensors().size}
        if twice := sorted(set(given) & set(self.network.arguments)):
            raise ConfigError(f"network.arguments with {twice}", "no such keys: they follow from sensor and channels")
        return given | self.network.arguments


class Selection(Section):
    """How timesteps are selected: see ``timesteps.select_timesteps``."""

    candidates: Count = 100
    trajectories: Count = 256
    batch: Count = 1
    seed: int = 0


class DistillConfig(Run):
    """A student that needs few steps.

    Args:
        teacher: checkpoint; its network, sensor, channels and normalisation are the student's.
        strategy: a name of ``STRATEGIES``.
        steps: Euler steps of the teacher per piece.
        intervals: N, steps of the student.
        grid: N + 1 descending times from 1 to 0; without it, ``adaptive_piecewise`` selects them and the other
            strategies take uniform ones.
        selection: how.
    """

    teacher: Path
    strategy: Literal[
        "adaptive_piecewise", "uniform_piecewise", "piecewise_reflow", "reflow", "timestep_distillation"
    ] = "adaptive_piecewise"
    steps: Count = 20
    intervals: Count = 4
    grid: tuple[float, ...] | None = None
    selection: Selection = Selection()


Config = TypeVar("Config", bound=Run)


def load_config(kind: type[Config], path: str | Path, overrides: Sequence[str] = ()) -> Config:
    """A configuration from a YAML file.

    Args:
        kind: ``TrainConfig`` or ``DistillConfig``.
        path: the file.
        overrides: ``key=value`` with dots between levels and values in YAML, such as ``recipe.batch=4``.

    Raises:
        FileError: where the file cannot be read.
        ConfigError: on what is no YAML, an unknown key, a value that does not fit or a resolution that the network
            cannot have.
    """
    try:
        values = yaml.safe_load(Path(path).read_text())
    except OSError as error:
        raise FileError(
            f"{path} cannot be read ({error.strerror})", "a configuration, such as those in configs/"
        ) from error
    except yaml.YAMLError as error:
        raise ConfigError(f"{path} is not YAML ({error})") from error
    if not isinstance(values, dict):
        raise ConfigError(f"{path} holds {type(values).__name__}", f"the keys {', '.join(kind.model_fields)}")
    for override in overrides:
        _override(values, override)
    try:
        config = kind.model_validate(values)
    except ValidationError as error:
        raise ConfigError(f"{path}: {_first(kind, error)}") from error
    check(config)
    return config


def check(config: Run) -> None:
    """Refuse what could not be built.

    Raises:
        ConfigError: naming it.
    """
    data = config.data
    if (data.town is None) == (data.path is None):
        raise ConfigError(f"data with town={data.town} and path={data.path}", "one of the two")
    if isinstance(config, TrainConfig) and config.init is None:
        with torch.device("meta"):  # no memory and no time: only whether the values fit together
            build_network(config.network.architecture, config.network_arguments())
    if isinstance(config, DistillConfig) and config.grid is not None:
        grid = config.grid
        if len(grid) != config.intervals + 1 or (grid[0], grid[-1]) != (1, 0) or sorted(set(grid))[::-1] != list(grid):
            raise ConfigError(f"grid {list(grid)}", f"{config.intervals + 1} descending times from 1 to 0")


def _override(values: dict[str, Any], override: str) -> None:
    key, equals, text = override.partition("=")
    if not equals or not key:
        raise ConfigError(f"override {override!r}", "key=value, such as recipe.batch=4")
    *levels, last = key.split(".")
    for level in levels:
        values = values.setdefault(level, {})
        if not isinstance(values, dict):
            raise ConfigError(f"override {override!r}: {level} is a single value", "a section")
    try:
        values[last] = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ConfigError(f"override {override!r}: {text!r} is not YAML", "a number, a word, a [list]") from error


def _first(kind: type[BaseModel], error: ValidationError) -> str:
    """The first complaint of pydantic, in one line that helps."""
    fault = error.errors()[0]
    place = ".".join(map(str, fault["loc"]))
    if fault["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        return f"unknown key {place!r}; known there: {', '.join(_keys(kind, fault['loc'][:-1]))}"
    if fault["type"] == "missing":
        return f"{place!r} is missing"
    return f"{place} = {fault['input']!r}: {fault['msg']}"


def _keys(kind: Any, path: Sequence[int | str]) -> list[str]:
    """Names of the fields at a place of the configuration."""
    for level in path:
        fields = getattr(kind, "model_fields", None) or getattr(kind, "__pydantic_fields__", {})
        kind = fields[level].annotation
    return list(getattr(kind, "model_fields", None) or getattr(kind, "__dataclass_fields__", {}))
