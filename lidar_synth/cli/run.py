"""A training configuration becomes a run in its output folder.

The folder holds::

    config.yaml              what was asked for, overrides included
    cache/                   the projected scans
    selection.npz            a student's timesteps and how they were found
    state.safetensors        to go on after a stop or a kill
    <folder>.safetensors     the checkpoint: the averaged weights, to use
    samples/, logs/          pictures; numbers for TensorBoard
"""

import json
import math
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
import yaml
from torch import nn
from tqdm import tqdm

from lidar_synth import __version__
from lidar_synth.checkpoint import VELOCITY, Header, Part, load_checkpoint, save_checkpoint
from lidar_synth.config import DistillConfig, Run, TrainConfig
from lidar_synth.errors import ConfigError, LibraryError
from lidar_synth.files import write_file
from lidar_synth.generator import Generator
from lidar_synth.nets import build_network
from lidar_synth.normalize import TensorFormat
from lidar_synth.sensor import load_sensor
from lidar_synth.solvers import uniform_grid
from lidar_synth.timesteps import Selection, select_timesteps
from lidar_synth.train import Batches, Record, Task, Training, cache_scans, steps, student_task, teacher_task
from lidar_synth.viz import write_view

if TYPE_CHECKING:
    from accelerate import Accelerator

_LOG_EVERY = 10  # steps between two numbers in the logs


class Plan(NamedTuple):
    """What is trained, on what, and what the checkpoint will say about it."""

    network: nn.Module
    task: Task
    header: Header


def run(config: TrainConfig | DistillConfig, resume: bool = False, minutes: float | None = None) -> Path:
    """Train as configured, with a bar, logs, pictures and saves.

    Args:
        config: of a teacher or of a student.
        resume: go on from the saved state in the output folder, where there is one.
        minutes: stop, saved, after so long.

    Returns:
        The checkpoint.

    Raises:
        ConfigError: where the folder holds a run and ``resume`` is not set.
        LibraryError: without Accelerate.
        DataError: where the training does not stay finite; what was saved last is kept.
    """
    try:
        from accelerate import Accelerator
    except ImportError as error:
        hint = "pip install 'lidar_synth[train]'"
        raise LibraryError("Accelerate is not installed", "the extra 'train'", hint) from error

    state = config.output / "state.safetensors"
    if state.exists() and not resume:
        raise ConfigError(f"{config.output} holds a run", "--resume to go on, or another output=FOLDER")
    accelerator = Accelerator(mixed_precision=config.precision)
    if accelerator.is_main_process:
        write_file(config.output / "config.yaml", yaml.safe_dump(config.model_dump(mode="json")).encode())
    plan = plan_student(config, accelerator) if isinstance(config, DistillConfig) else plan_teacher(config)
    training = Training(plan.network.to(accelerator.device), config.recipe)
    if state.exists():
        training.load(state)
    if config.compile:
        plan.network.compile()
    if config.gradient_checkpointing:
        plan.network.gradient_checkpointing = True  # type: ignore[assignment]
    return _train(config, plan, training, accelerator, minutes)


def checkpoint_path(config: Run) -> Path:
    """Where a run leaves its checkpoint; the name goes into the ids of its scans."""
    return config.output / f"{config.output.name}.safetensors"


def plan_teacher(config: TrainConfig) -> Plan:
    """Flow matching, from fresh weights or from those of ``config.init``."""
    task = teacher_task(config.timesteps)
    provenance = _provenance(config)
    if config.init is not None:
        start = load_checkpoint(config.init)
        _check_init(config, start.header)
        provenance |= {"init": start.hash, "init_provenance": start.header.provenance}
        header = replace(start.header, time_grid=uniform_grid(config.steps), provenance=provenance)
        return Plan(start.networks[VELOCITY], task, header)
    sensor = load_sensor(config.sensor)
    part = Part(config.network.architecture, config.network_arguments())
    torch.manual_seed(config.seed)
    angles = torch.from_numpy(sensor.ray_angles(config.rays))
    network = build_network(part.architecture, part.arguments | {"angles": angles})
    tensors = config.tensors()
    header = Header(
        networks={VELOCITY: part},
        sensor=sensor,
        normalisation=tensors.normalisation,
        channels=tensors.channels,
        time_grid=uniform_grid(config.steps),
        provenance=provenance,
    )
    return Plan(network, task, header)


def _check_init(config: TrainConfig, header: Header) -> None:
    """What the configuration says of the network, if it says it, has to be what the checkpoint holds."""
    part = header.networks[VELOCITY]
    held = {
        "sensor": header.sensor.to_dict(),
        "channels": list(header.channels),
        "normalisation": header.normalisation.to_dict(),
        "network": {"architecture": part.architecture, "arguments": part.arguments},
    }
    arguments = part.arguments | config.network.arguments
    asked = {
        "sensor": load_sensor(config.sensor).to_dict(),
        "channels": list(config.channels),
        "normalisation": config.tensors().normalisation.to_dict(),
        "network": {"architecture": config.network.architecture, "arguments": arguments},
    }
    for key in held.keys() & config.model_fields_set:
        if json.dumps(asked[key], sort_keys=True) != json.dumps(held[key], sort_keys=True):
            raise ConfigError(f"{key} {asked[key]}", f"that of {config.init}: {held[key]}", f"Or leave out {key}.")


def plan_student(config: DistillConfig, accelerator: "Accelerator") -> Plan:
    """Distillation on the given, the selected or a uniform grid, from the teacher's weights."""
    teacher = load_checkpoint(config.teacher, accelerator.device)
    velocity = teacher.networks[VELOCITY].requires_grad_(False)
    if config.compile:
        velocity.compile()
    provenance = _provenance(config) | {"teacher": teacher.hash, "teacher_provenance": teacher.header.provenance}
    grid = config.grid or uniform_grid(config.intervals)
    if config.grid is None and config.strategy == "adaptive_piecewise":
        with accelerator.main_process_first():
            selection = _selection(config, velocity, teacher.header, accelerator)
        grid = selection.grid
        provenance |= {"selection": {"cost": selection.cost, "uniform_cost": selection.uniform_cost}}
    header = replace(teacher.header, time_grid=grid, provenance=provenance)
    student = load_checkpoint(config.teacher).networks[VELOCITY]
    return Plan(student, student_task(config.strategy, velocity, grid, config.steps), header)


def _provenance(config: Run) -> dict[str, Any]:
    return {
        "data": config.data.describe(),
        "data_licence": config.data.licence,
        "licence": config.licence,
        "recipe": config.model_dump(mode="json", exclude={"output", "data", "licence", "samples", "save_every"}),
        "software": f"lidar_synth {__version__}, torch {torch.__version__}",
    }


def _selection(config: DistillConfig, velocity: nn.Module, header: Header, accelerator: "Accelerator") -> Selection:
    """The timesteps of the student, from the folder where an earlier call left them."""
    path = config.output / "selection.npz"
    if path.exists():
        with np.load(path) as values:
            return Selection(
                tuple(values["grid"].tolist()), float(values["cost"]), float(values["uniform_cost"]),
                tuple(values["candidates"].tolist()), values["costs"], values["per_trajectory"],
            )  # fmt: skip
    tensors = TensorFormat(header.channels, header.normalisation)
    with accelerator.autocast():
        selection = select_timesteps(
            velocity, (tensors.size, *header.sensor.shape), config.intervals, metric=config.recipe.metric,
            device=accelerator.device, **config.selection.model_dump(),
        )  # fmt: skip
    write_file(path, lambda file: np.savez(file, **asdict(selection)))
    tqdm.write(f"timesteps {selection.grid}: cost {selection.cost:.4g}, uniform {selection.uniform_cost:.4g}")
    return selection


def _train(config: Run, plan: Plan, training: Training, accelerator: "Accelerator", minutes: float | None) -> Path:
    """The loop, its logs and its saves."""
    sensor, tensors = plan.header.sensor, TensorFormat(plan.header.channels, plan.header.normalisation)
    with accelerator.main_process_first():
        folder = config.data.cache or config.output / "cache"
        source = config.data.open(sensor)
        cache = cache_scans(source, sensor, tensors.channels, folder, config.data.describe())
    data = Batches(cache, tensors, config.seed, config.data.flip, config.data.roll, accelerator.device)
    log = _Log(config, training.step) if accelerator.is_main_process else None
    end = math.inf if minutes is None else time.monotonic() + 60 * minutes
    for record in steps(training, plan.task, data, accelerator):
        # All processes stop at the same step, whose clock ever is ahead.
        late = accelerator.reduce(torch.tensor(float(time.monotonic() > end), device=accelerator.device)).item() > 0
        last = late or record.step == config.recipe.iterations
        if log is not None:
            log.add(record)
            if last or record.step % config.save_every == 0:
                _save(config, plan, training)
            if config.samples.every and (last or record.step % config.samples.every == 0):
                with accelerator.autocast():
                    log.picture(plan.header, training)
        if late:
            break
    if log is not None:
        log.close()
    accelerator.wait_for_everyone()
    return checkpoint_path(config)


def _save(config: Run, plan: Plan, training: Training) -> None:
    training.save(config.output / "state.safetensors")
    header = replace(plan.header, provenance=plan.header.provenance | {"iterations": training.step})
    save_checkpoint(checkpoint_path(config), header, {VELOCITY: training.average})


class _Log:
    """A bar, TensorBoard's numbers, pictures."""

    def __init__(self, config: Run, step: int) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self.config = config
        self.board: Any = SummaryWriter(config.output / "logs", purge_step=step + 1)
        self.bar = tqdm(total=config.recipe.iterations, initial=step, desc=config.output.name, unit="step")
        self.records: list[Record] = []

    def add(self, record: Record) -> None:
        self.records.append(record)
        self.bar.update()
        if record.step % _LOG_EVERY and record.step != self.config.recipe.iterations:
            return
        mean = sum(r.loss for r in self.records) / len(self.records)
        evaluations = sum(r.teacher_evaluations for r in self.records)
        self.records.clear()
        for name, value in (("loss", mean), ("gradient", record.gradient), ("rate", record.rate)):
            self.board.add_scalar(name, value, record.step)
        if evaluations:
            self.board.add_scalar("teacher_evaluations", evaluations, record.step)
        self.bar.set_postfix(loss=f"{mean:.4f}", refresh=False)

    def close(self) -> None:
        self.bar.close()
        self.board.close()

    def picture(self, header: Header, training: Training) -> None:
        generator = Generator(self.config.output.name, training.average, header)
        scans = generator.scans(0, range(self.config.samples.count))
        path = self.config.output / "samples" / f"{training.step:07d}.png"
        write_view(path, scans, title=f"{self.config.output.name}, {training.step} iterations")
