"""Distillation of a student from a teacher, with or without guidance, on the given, the selected or
uniform timesteps."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch import nn

from lidar_synth.errors import ConfigError
from lidar_synth.generate.checkpoint import (
    CODEC,
    VELOCITY,
    Checkpoint,
    Header,
    join,
    load_checkpoint,
)
from lidar_synth.generate.conditions import CONDITIONS, Conditioned, blank
from lidar_synth.generate.flow.distill import STRATEGIES, every_piece
from lidar_synth.generate.flow.guidance import autoguide, guide
from lidar_synth.generate.flow.path import (
    Example,
    Velocity,
    balanced_velocity_loss,
)
from lidar_synth.generate.flow.solvers import uniform_grid
from lidar_synth.generate.loading import find_model
from lidar_synth.generate.models import build_network
from lidar_synth.generate.models.encoders.clip_views import ClipViewEncoder
from lidar_synth.lab.train.config import DistillConfig
from lidar_synth.lab.train.data import Batch, Batches
from lidar_synth.lab.train.moments import measure_matches
from lidar_synth.lab.train.precision import choose_precision, convert_products
from lidar_synth.lab.train.provenance import provenance_of
from lidar_synth.lab.train.ranks import ALONE, Ranks
from lidar_synth.lab.train.selection import TimestepSelection
from lidar_synth.lab.train.stage import Stage, Task, latent_weights
from lidar_synth.noise import gaussian

if TYPE_CHECKING:
    from accelerate import Accelerator


MEASURED = 64
"""Number of samples whose moments are measured."""
ROUNDING = 2**-7
SMALL = 1e-6
"""Relative and absolute differences of weights that were stored in float16 or bfloat16."""


def student_task(
    strategy: str, teacher: Velocity, grid: Sequence[float], steps: int
) -> Task:
    """Distillation of ``teacher`` by one of ``STRATEGIES`` on the student's ``grid`` with ``steps``
    Euler steps of the teacher per piece (Algorithm 1)."""

    def task(batch: Batch) -> Example:
        example = STRATEGIES[strategy](
            teacher, batch.y0, batch.y1, batch.u, grid, steps, batch.cond
        )
        return replace(example, cond=batch.cond)

    return task


def several_steps_task(
    teacher: Velocity, grids: Sequence[Sequence[float]], steps: int
) -> Task:
    """Distillation of ``teacher`` for several numbers of steps (``every_piece``)."""
    return lambda batch: every_piece(
        teacher, batch.y0, batch.y1, grids, steps, batch.cond
    )


class StudentStage(Stage):
    """The training of a student from its teacher's weights, after the selection of its timesteps,
    or from those of a student, which has them.

    Attributes:
        flow: what it is distilled from.
        selection: of its timesteps; None where they are given or uniform.

    Raises:
        ConfigError: where the configuration does not fit the teacher.
    """

    config: DistillConfig

    def __init__(self, config: DistillConfig, device: torch.device | str) -> None:
        teacher = load_checkpoint(config.teacher, device)
        _check_teacher(config, teacher)
        self.flow, made = target_flow(config, teacher, device)
        header = replace(
            teacher.header,
            time_grid=config.grid or uniform_grid(config.intervals),
            provenance=provenance_of(config) | made,
        )
        start = load_checkpoint(find_model(config.init or config.teacher))
        networks = start.networks
        if config.init is not None:
            header = _take_start(config, header, teacher, start)
        if config.also:
            header = _add_ends(config, networks, header)
            self.loss = balanced_velocity_loss
        frozen = {name: networks.pop(name) for name in [CODEC] if name in networks}
        super().__init__(config, join(networks), header, frozen, device)
        self.selection = None
        if config.selects:
            self.selection = TimestepSelection(config, self.header)

    def prepare(
        self, data: Batches, accelerator: "Accelerator", ranks: Ranks = ALONE
    ) -> None:
        """Select the timesteps, unless they are given, uniform or selected already."""
        config = self.config
        if self.selection is not None:
            with accelerator.autocast():
                found = self.selection.run(self.flow, self.codec.shape, data, ranks)
            others = tuple(found.grid_of(intervals) for intervals in config.also)
            self.header = replace(self.header, time_grid=found.grid, other_grids=others)
            self.add_facts(
                selection={"cost": found.cost, "uniform_cost": found.uniform_cost}
            )
        grid = self.header.time_grid
        if config.also:
            grids = (grid, *self.header.other_grids)
            self.task = several_steps_task(self.flow, grids, config.steps)
        else:
            self.task = student_task(config.strategy, self.flow, grid, config.steps)

    def finish(self, network: nn.Module, data: Batches) -> None:
        """Match the moments of states in fewer steps to those in the most steps."""
        if self.header.other_grids:
            noise = gaussian(0, range(MEASURED), self.codec.shape, self.device)
            found = measure_matches(
                network, self.header, noise, data.conditions(range(MEASURED))
            )
            self.header = replace(self.header, matches=found)


def _check_teacher(config: DistillConfig, teacher: Checkpoint) -> None:
    """Refuse what is no teacher for this configuration."""
    given = f"teacher {config.teacher}"
    if VELOCITY not in teacher.networks:
        raise ConfigError(f"{given}, an autoencoder", "a model that generates")
    if teacher.header.networks[VELOCITY].arguments.get("ends"):
        raise ConfigError(
            f"{given}, a student of several numbers of steps", "its teacher"
        )
    learnt_from = teacher.header.provenance.get("data")
    if config.data.town is not None and isinstance(learnt_from, dict):
        path = learnt_from.get("path")
        if path:  # shipped recipes name the town's scans
            raise ConfigError(
                f"data.town={config.data.town} for {given}, which learnt from {path}",
                "the teacher's scans",
                f"data.town=null data.path={path} data.licence=LICENCE",
            )
    if CODEC in teacher.networks and config.recipe.weights:
        raise ConfigError(
            f"recipe.weights {dict(config.recipe.weights)} of a latent model",
            "none: latents are mixed",
        )


def _take_start(
    config: DistillConfig, header: Header, teacher: Checkpoint, start: Checkpoint
) -> Header:
    """Take the networks and the times of a student that is trained further.

    Raises:
        ConfigError: if it is the student of another kind of teacher, of one on other latents, of
            other numbers of steps, or of other times than ``config.grid``.
    """
    differs = _differences(teacher, start)
    grids = (start.header.time_grid, *start.header.other_grids)
    intervals = [len(grid) - 1 for grid in grids]
    wanted = [config.intervals, *config.also]
    if differs or intervals != wanted:
        raise ConfigError(
            f"init {config.init} with "
            + (f"another {', '.join(differs)}" if differs else f"{intervals} steps"),
            f"a student of {config.teacher} in {wanted} steps",
        )
    if config.grid not in (None, grids[0]):
        raise ConfigError(
            f"grid {config.grid} with init {config.init}",
            f"its own, {grids[0]}",
            "Or leave out grid (grid=null).",
        )
    made = {"init": start.hash, "init_provenance": start.header.provenance}
    return replace(
        header,
        networks=start.header.networks,
        time_grid=grids[0],
        other_grids=grids[1:],
        provenance=header.provenance | made,
    )


def _differences(one: Checkpoint, other: Checkpoint) -> list[str]:
    """Which of what decides the states and the conditions of a flow differs between two models."""
    shared = ("sensor", "channels", "normalisation")
    found = [k for k in shared if getattr(one.header, k) != getattr(other.header, k)]
    if _shown(one) != _shown(other):
        found.append("conditioning")
    return found if _same_latents(one, other) else [*found, "autoencoder"]


def _shown(model: Checkpoint) -> dict[str, dict[str, Any]]:
    """The conditions of a model, as training shows them: with their gaps."""
    return {
        name: options | {"keep_gaps": True}
        for name, options in model.header.conditioning.items()
    }


def _same_latents(one: Checkpoint, other: Checkpoint) -> bool:
    """Whether the autoencoders of two models encode alike, up to the rounding of stored weights."""
    a, b = (
        latent_weights(c.networks[CODEC]) if CODEC in c.networks else {}
        for c in (one, other)
    )
    return a.keys() == b.keys() and all(
        v.shape == b[n].shape and torch.allclose(v, b[n], ROUNDING, SMALL)
        for n, v in a.items()
    )


def _add_ends(
    config: DistillConfig, networks: dict[str, nn.Module], header: Header
) -> Header:
    """Replace the velocity by one that is told where a step ends; before training, it is the
    teacher nevertheless."""
    given = f"also={list(config.also)}"
    if config.grid is not None:
        raise ConfigError(
            f"{given} with grid={list(config.grid)}",
            "grid=null: the times of all numbers of steps are selected together",
        )
    held = header.networks[VELOCITY]
    if held.architecture != "hdit" or config.strategy != "adaptive_piecewise":
        raise ConfigError(
            f"{given} for a {held.architecture} by {config.strategy}",
            "an hdit, adaptive_piecewise",
            "Give also=[] for one number of steps.",
        )
    part = held._replace(arguments=held.arguments | {"ends": True})
    torch.manual_seed(config.seed)
    velocity = build_network(*part)
    velocity.load_state_dict(networks[VELOCITY].state_dict(), strict=False)
    networks[VELOCITY] = velocity
    return replace(header, networks=header.networks | {VELOCITY: part})


def target_flow(
    config: DistillConfig, teacher: Checkpoint, device: torch.device | str
) -> tuple[Velocity, dict[str, Any]]:
    """The velocity that a student is distilled from, and its part of the student's provenance.

    Args:
        config: of the student.
        teacher: the checkpoint of ``config.teacher``.
        device: of the training.

    Raises:
        ConfigError: on classifier-free guidance of a teacher without dropout of its condition or
            within some times only, or a weaker model of other data.
    """
    made = {"teacher": teacher.hash, "teacher_provenance": teacher.header.provenance}
    velocity = _frozen_flow(teacher, config)
    if config.weaker is None:
        if config.within != (0, 1):
            raise ConfigError(
                f"within {config.within} without weaker",
                "weaker=CHECKPOINT: within is of autoguidance",
            )
        return _from_blank(config, teacher, velocity), made
    weaker = load_checkpoint(config.weaker, device)
    _check_weaker(config, teacher, weaker)
    made |= {"weaker": weaker.hash, "weaker_provenance": weaker.header.provenance}
    other = _frozen_flow(weaker, config)
    return autoguide(velocity, other, config.guidance, config.within), made


def _frozen_flow(checkpoint: Checkpoint, config: DistillConfig) -> nn.Module:
    """The flow of a checkpoint, with frozen weights."""
    velocity = join(checkpoint.networks).requires_grad_(False)
    if choose_precision(config.precision) == "bf16":
        convert_products(checkpoint.networks[VELOCITY])
    if config.compile:
        velocity.compile()
    return velocity


def _from_blank(
    config: DistillConfig, teacher: Checkpoint, velocity: nn.Module
) -> Velocity:
    """The teacher with classifier-free guidance, if any."""
    if config.guidance == 1:
        return velocity
    given = f"guidance {config.guidance}"
    if not isinstance(velocity, Conditioned):
        raise ConfigError(
            f"{given} of an unconditional teacher", "1, or weaker=CHECKPOINT"
        )
    [(name, options)] = teacher.header.conditioning.items()
    if not options.get("dropout"):
        raise ConfigError(
            f"{given} of a teacher that was trained without dropout of its condition",
            "1",
        )
    encoder = velocity.encoder
    empty = torch.zeros(CONDITIONS[name].shape(encoder), dtype=torch.uint8)
    nothing = blank(name, empty)
    if isinstance(encoder, ClipViewEncoder):  # it is trained on features
        place = encoder.view_embedding.device
        nothing = encoder.look(nothing[None].to(place))[0]
    return guide(velocity, config.guidance, nothing)


def _check_weaker(
    config: DistillConfig, teacher: Checkpoint, weaker: Checkpoint
) -> None:
    """Both models need the same states and conditions."""
    given = f"weaker {config.weaker}"
    if config.guidance == 1:
        raise ConfigError(
            f"{given} with guidance 1", "a guidance scale other than 1, such as 2"
        )
    if not 0 <= config.within[0] < config.within[1] <= 1:
        raise ConfigError(
            f"within {config.within}", "two increasing times within [0, 1]"
        )
    if VELOCITY not in weaker.networks:
        raise ConfigError(f"{given}, an autoencoder", "a model that generates")
    if differs := _differences(teacher, weaker):
        raise ConfigError(
            f"{given} of another {', '.join(differs)}", f"those of {config.teacher}"
        )
