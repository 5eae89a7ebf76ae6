"""A model from its stages: each is a run in a folder of its own, and starts from the checkpoints of
earlier ones.

The folder of the model, ``runs/NAME``, holds::

    STAGE/               the run of a stage, with its state and its checkpoint STAGE.safetensors
    NAME.safetensors     the checkpoint of the last stage, in half precision where it would be large
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from lidar_synth.errors import ConfigError
from lidar_synth.generate.checkpoint import (
    load_checkpoint,
    read_header,
    save_checkpoint,
)
from lidar_synth.lab.train.model_plan import ModelPlan
from lidar_synth.lab.train.resume import check_done, is_missing
from lidar_synth.lab.train.runs import run
from lidar_synth.lab.train.staged import iterations_of, set_iterations, train_for

LARGE = 14.4e6
"""Bytes of weights in float32 from which on a model is stored in half precision."""


def train_model(plan: ModelPlan) -> Path:
    """Run the stages of a model one after the other; a second call resumes, and keeps the stages
    that are done.

    Args:
        plan: of the model, from ``plan_model``.

    Returns:
        The checkpoint of the last stage, which ``load_generator`` reads unless it is an
        autoencoder.

    Raises:
        ConfigError: if a checkpoint to start from is missing, a stage that is done had other
            settings or started from another checkpoint, or the time is too short for its warm-up.
        LibraryError: if Accelerate (extra ``train``) is not installed.

    Example:
        >>> from lidar_synth.lab.train import plan_model, train_model
        >>> try:
        ...     train_model(plan_model("town-layout", ["output=runs/elsewhere/town-layout"]))
        ... except ValueError as error:
        ...     print(str(error).split(";")[0])
        teacher.init=runs/elsewhere/town/teacher/teacher.safetensors, which does not exist
    """
    runs = plan.runs
    for name in plan.stages:
        if not runs.is_done(name):
            _check_starts(plan, name)
    for number, (name, stage) in enumerate(plan.stages.items(), 1):
        if runs.is_done(name) and _still_done(plan, name):
            continue
        tqdm.write(
            f"{plan.name}: stage {number} of {len(plan.stages)}, {name} ({stage.recipe})"
        )
        if stage.minutes is None:
            run(stage.config, resume=True)
        else:
            train_for(stage.config, runs.budgets(plan.minutes)[name])
        runs.mark_done(name)
    return plan.out if plan.out == runs.checkpoint(name) else _export(plan, name)


def _check_starts(plan: ModelPlan, name: str) -> None:
    """Refuse a stage before anything runs if a checkpoint is missing that no stage makes."""
    stage = plan.stages[name]
    made = {plan.runs.checkpoint(other) for other in plan.stages}
    for key, path in stage.starts.items():
        if path in made or not is_missing(path):
            continue
        expected = "a checkpoint"
        hint = f"Give {name}.{key}=FILE.safetensors."
        if key in stage.of_others:
            model, _, other = stage.of_others[key].partition("/")
            expected = f"the checkpoint of the stage {other} of {model}"
            at = (
                ""
                if path.parents[1] == Path("runs", model)
                else f" output={path.parents[1]}"
            )
            hint = f"Type `lidar-synth train {model} --until {other}{at}` first, or give {hint[5:]}"
        raise ConfigError(f"{name}.{key}={path}, which does not exist", expected, hint)


def _still_done(plan: ModelPlan, name: str) -> bool:
    """Whether a stage that is done needs no more iterations; other settings and other starts are
    refused."""
    stage = plan.stages[name]
    done = iterations_of(stage.config)
    config = (
        stage.config if stage.minutes is None else set_iterations(stage.config, done)
    )
    check_done(config)
    return config.recipe.iterations == done


def _export(plan: ModelPlan, last: str) -> Path:
    """Write the model as the package ships it; its provenance names the stages."""
    checkpoint = load_checkpoint(plan.runs.checkpoint(last))
    stages: dict[str, Any] = {}
    for name, stage in plan.stages.items():
        facts = read_header(plan.runs.checkpoint(name))[0].provenance
        stages[name] = {"recipe": stage.recipe, "iterations": facts["iterations"]}
    header = checkpoint.header
    header = replace(
        header, provenance=header.provenance | {"model": plan.name, "stages": stages}
    )
    size = 4 * sum(
        p.numel()
        for network in checkpoint.networks.values()
        for p in network.parameters()
    )
    save_checkpoint(
        plan.out,
        header,
        checkpoint.networks,
        torch.float16 if size >= LARGE else torch.float32,
    )
    return plan.out
