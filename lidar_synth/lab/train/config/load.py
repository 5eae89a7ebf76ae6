"""From a recipe to checked values; unknown keys are refused, with the known ones named."""

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import torch
from pydantic import BaseModel

from lidar_synth.errors import ConfigError
from lidar_synth.files.parsing import parse_yaml
from lidar_synth.files.recipes import find_recipe, merge, read_recipe, validate
from lidar_synth.generate.checkpoint import CODEC
from lidar_synth.generate.codec import make_codec
from lidar_synth.generate.flow.distill import check_uniform
from lidar_synth.generate.flow.solvers import read_grid
from lidar_synth.generate.models import build_network
from lidar_synth.geometry import load_sensor
from lidar_synth.lab.train.config.sections import Run
from lidar_synth.lab.train.config.training import DistillConfig, TrainConfig

Config = TypeVar("Config", bound=Run)


def load_config(
    kind: type[Config],
    recipe: str | Path,
    overrides: Sequence[str] = (),
    values: Mapping[str, Any] | None = None,
) -> Config:
    """The configuration of a recipe.

    Args:
        kind: ``TrainConfig`` or ``DistillConfig``.
        recipe: a published recipe's name, such as ``town_teacher``, or a YAML file.
        overrides: ``key=value`` with dots between levels and values in YAML, such as
            ``recipe.batch=4``.
        values: plain values on top of the recipe's and below the overrides.

    Returns:
        The checked configuration, for ``run``.

    Raises:
        FileError: where the file cannot be read.
        ConfigError: on a file that is not YAML, an unknown key, an invalid value or a resolution
            that the network cannot have.

    Example:
        >>> from lidar_synth.lab.train import TrainConfig, load_config
        >>> config = load_config(TrainConfig, "town_tiny", ["recipe.batch=4", "output=runs/mine"])
        >>> config.recipe.batch, config.recipe.iterations, config.output.as_posix()
        (4, 200, 'runs/mine')
    """
    given = merge(read_values(recipe, kind), dict(values or {}))
    for override in overrides:
        _override(given, override)
    config = validate(kind, given, str(recipe))
    check(config)
    return config


def read_values(given: str | Path, kind: type[BaseModel]) -> dict[str, Any]:
    """The values of a recipe for a ``kind``, its bases included, not checked yet; raises as
    ``load_config``.

    A run without ``output`` gets the folder ``runs/NAME``.
    """
    path = find_recipe(given)
    values = read_recipe(path)
    if issubclass(kind, Run):
        values.setdefault("output", f"runs/{path.stem}")
    return values


_BEGINNINGS = {
    "warmup": "the learning rate does not reach recipe.rate before the end",
    "ema_after": "no weights are averaged",
}


def check(config: Run) -> None:
    """Refuse what could not be built, and warn of a run too short for its recipe.

    Raises:
        ConfigError: naming it.
    """
    held = config.held_out.data if config.held_out else None
    for data in filter(None, (config.data, held, config.rehearsal)):
        for one in data.parts():
            if (one.town is None) == (one.path is None):
                raise ConfigError(
                    f"data with town={one.town} and path={one.path}", "one of the two"
                )
    iterations = config.recipe.iterations
    for key, effect in _BEGINNINGS.items():
        if (steps := getattr(config.recipe, key)) >= iterations:
            warnings.warn(
                f"recipe.{key}={steps} with recipe.iterations={iterations}: {effect}; give less",
                stacklevel=3,
            )
    if isinstance(config, TrainConfig):
        _check_train(config)
    if isinstance(config, DistillConfig):
        _check_distill(config)


def _check_distill(config: DistillConfig) -> None:
    candidates = config.selection.candidates
    counts = (config.intervals, *config.also)
    if len(set(counts)) < len(counts):
        raise ConfigError(
            f"intervals={config.intervals} with also={list(config.also)}",
            "each number of steps once",
        )
    most = max(counts)
    if config.selects and most > candidates:
        raise ConfigError(
            f"{most} steps of selection.candidates={candidates} times",
            f"at most {candidates}",
            f"Give selection.candidates={most} or more.",
        )
    if config.grid is None:
        return
    if len(read_grid(config.grid)) != config.intervals + 1:
        raise ConfigError(
            f"grid {list(config.grid)}",
            f"{config.intervals + 1} descending times from 1 to 0",
            "Or give no grid (grid=null).",
        )
    if config.strategy != "adaptive_piecewise":
        check_uniform(config.grid)


def _check_train(config: TrainConfig) -> None:
    if config.autoencodes and (config.codec or config.condition):
        raise ConfigError(
            "an autoencoder with a codec or a condition",
            "neither: they belong to a flow",
        )
    if config.decoder and (config.init is None or config.codec or config.condition):
        raise ConfigError(
            "decoder without init, or with a codec or a condition",
            "init: a latent model, with its own ones",
        )
    if config.codec is not None and config.recipe.weights:
        raise ConfigError(
            f"recipe.weights {dict(config.recipe.weights)} of a latent model",
            "none: latents are mixed",
        )
    # what a codec makes is in its file
    if config.init is None and config.codec is None:
        resolution = load_sensor(config.sensor).shape
        config.parts((config.tensors().size, *resolution), resolution)


def check_latents(flow: TrainConfig, codec: TrainConfig) -> None:
    """Refuse a flow on the latents of an autoencoder that is to be trained first, if its networks
    cannot have their shape.

    Raises:
        ConfigError: naming the sensor of the autoencoder.
    """
    sensor = load_sensor(codec.sensor)
    rows, columns = sensor.shape
    tensors = codec.tensors()
    parts = codec.parts((tensors.size, rows, columns), sensor.shape)
    with torch.device("meta"):
        network = build_network(*parts[CODEC])
    state = make_codec(network, tensors, sensor.shape).shape
    try:
        flow.parts(state, sensor.shape)
    except ConfigError as error:
        raise ConfigError(
            f"sensor {sensor.name!r} of {rows} x {columns} cells, whose latents have {state[1]} x "
            f"{state[2]}: {error}"
        ) from error


def _override(values: dict[str, Any], override: str) -> None:
    key, equals, text = override.partition("=")
    if not equals or not key:
        raise ConfigError(f"override {override!r}", "key=value, such as recipe.batch=4")
    *levels, last = key.split(".")
    for level in levels:
        values = values.setdefault(level, {})
        if not isinstance(values, dict):
            raise ConfigError(
                f"override {override!r}: {level} is a single value", "a section"
            )
    values[last] = parse_yaml(text, f"override {override!r}")
