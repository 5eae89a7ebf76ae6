"""From a training configuration to what a run needs: networks, task, data and the header of the
checkpoint."""

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn
from tqdm import tqdm

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.generate.checkpoint import (
    CODEC,
    ENCODER,
    VELOCITY,
    Checkpoint,
    Header,
    join,
    load_checkpoint,
    network_hash,
    split,
)
from lidar_synth.generate.codec import Codec, make_codec
from lidar_synth.generate.conditions import CONDITIONS, resize_image
from lidar_synth.generate.flow.path import (
    METRICS,
    balanced_velocity_loss,
    velocity_loss,
)
from lidar_synth.generate.flow.solvers import mean_velocity, uniform_grid
from lidar_synth.generate.flow.timesteps import Selection, select_timesteps
from lidar_synth.generate.loading import find_model
from lidar_synth.generate.models import build_network
from lidar_synth.generate.models.bounded_latent import BoundedAutoencoder
from lidar_synth.geometry.scan import Scan, Source
from lidar_synth.geometry.sensor import Sensor
from lidar_synth.lab.town.town import Town
from lidar_synth.lab.train.autoencoder import (
    Autoencoding,
    autoencoder_loss,
    reconstruction_task,
)
from lidar_synth.lab.train.cache import Other, cache_latents, cache_scans
from lidar_synth.lab.train.config import Data, DistillConfig, Run, TrainConfig
from lidar_synth.lab.train.data import Batches, Conditioning
from lidar_synth.lab.train.decoding import Decoding, decoding_loss, decoding_task
from lidar_synth.lab.train.loop import (
    Loss,
    Task,
    several_steps_task,
    student_task,
    teacher_task,
)
from lidar_synth.lab.train.selection import (
    load_selection,
    save_selection,
    selection_settings,
)
from lidar_synth.lab.train.start import (
    add_recordings,
    fresh_networks,
    provenance_of,
    start_networks,
)
from lidar_synth.lab.train.teaching import target_flow

if TYPE_CHECKING:
    from accelerate import Accelerator


@dataclass(frozen=True)
class TrainingPlan:
    """A run before its first step.

    Args:
        network: the trained module.
        task: makes training examples of batches.
        header: of the checkpoint.
        loss: the minimised loss.
        frozen: parts of the checkpoint that are not trained, such as the autoencoder of a latent
            model.
    """

    network: nn.Module
    task: Task
    header: Header
    loss: Loss = velocity_loss
    frozen: Mapping[str, nn.Module] = field(default_factory=dict)

    @property
    def autoencoder(self) -> nn.Module | None:
        """The frozen autoencoder of a latent model, or None."""
        return self.frozen.get(CODEC)

    def codec(self) -> Codec:
        """The codec between tensors and states."""
        return make_codec(
            self.autoencoder, self.header.tensors, self.header.sensor.shape
        )

    def parts(self, network: nn.Module) -> dict[str, nn.Module]:
        """The parts of the checkpoint, from the network or its averaged copy."""
        trained = (
            {CODEC: network.network}
            if isinstance(network, Autoencoding)
            else split(network)
        )
        return {**trained, **self.frozen}


def make_plan(
    config: TrainConfig | DistillConfig, accelerator: "Accelerator"
) -> TrainingPlan:
    """The plan of a teacher, an autoencoder, a decoder or a student.

    Raises:
        ConfigError: where the configuration does not fit the checkpoints that it names.
    """
    if isinstance(config, DistillConfig):
        plan = plan_student(config, accelerator)
    elif config.decoder:
        plan = plan_decoder(config, accelerator)
    else:
        plan = (
            plan_autoencoder(config)
            if config.autoencodes
            else plan_teacher(config, accelerator)
        )
    return replace(plan, header=add_recordings(config, plan.header))


def plan_teacher(config: TrainConfig, accelerator: "Accelerator") -> TrainingPlan:
    """Flow matching, from random weights or from those of ``config.init``."""
    task = teacher_task(config.timesteps)
    networks, header = (
        start_networks(config) if config.init is not None else fresh_networks(config)
    )
    if config.codec is not None and CODEC not in networks:
        networks[CODEC] = load_checkpoint(config.codec).networks[CODEC]
    autoencoder = networks.get(CODEC)
    if autoencoder is not None:
        autoencoder.requires_grad_(False).to(accelerator.device)
    return TrainingPlan(join(networks), task, header, frozen=_codec_of(networks))


def plan_autoencoder(config: TrainConfig) -> TrainingPlan:
    """An autoencoder, from random weights or from those of ``config.init``."""
    networks, header = (
        start_networks(config) if config.init is not None else fresh_networks(config)
    )
    recipe = config.recipe
    network: Any = networks[CODEC]
    trained = Autoencoding(
        network,
        header.tensors,
        header.sensor,
        config.losses,
        METRICS[recipe.metric],
        recipe.weights,
    )
    return TrainingPlan(trained, reconstruction_task, header, autoencoder_loss)


def plan_decoder(config: TrainConfig, accelerator: "Accelerator") -> TrainingPlan:
    """The decoder of a latent model, on latents that its flow generates."""
    networks, header = start_networks(config)
    network = networks[CODEC]
    if not isinstance(network, BoundedAutoencoder):
        raise ConfigError(
            f"decoder with init {config.init}",
            "a model whose autoencoder predicts distributions",
        )
    frozen = {
        name: part.requires_grad_(False).to(accelerator.device)
        for name, part in networks.items()
        if name != CODEC
    }
    for weight in network.encoder():
        weight.requires_grad_(False)
    recipe = config.recipe
    trained = Decoding(
        network,
        header.tensors,
        header.sensor,
        config.losses,
        METRICS[recipe.metric],
        recipe.weights,
    )
    velocity = mean_velocity(join(frozen), header.time_grid)
    task = decoding_task(network, velocity, header.time_grid[-2], config.losses.noise)
    return TrainingPlan(trained, task, header, decoding_loss, frozen)


def plan_student(config: DistillConfig, accelerator: "Accelerator") -> TrainingPlan:
    """Distillation on the given, the selected or a uniform grid, from the teacher's weights."""
    if config.also and config.grid is not None:
        raise ConfigError(
            f"also={list(config.also)} with grid={list(config.grid)}",
            "grid=null: the times of all numbers of steps are selected together",
        )
    teacher = load_checkpoint(config.teacher, accelerator.device)
    if VELOCITY not in teacher.networks:
        raise ConfigError(
            f"teacher {config.teacher}, an autoencoder", "a model that generates"
        )
    if teacher.header.networks[VELOCITY].arguments.get("ends"):
        raise ConfigError(
            f"teacher {config.teacher}, a student of several numbers of steps",
            "its teacher",
        )
    _check_scans(config, teacher.header)
    if CODEC in teacher.networks and config.recipe.weights:
        raise ConfigError(
            f"recipe.weights {dict(config.recipe.weights)} of a latent model",
            "none: latents are mixed",
        )
    flow, made = target_flow(config, teacher, accelerator.device)
    provenance = provenance_of(config) | made
    header = replace(
        teacher.header,
        time_grid=config.grid or uniform_grid(config.intervals),
        provenance=provenance,
    )
    start = load_checkpoint(find_model(config.init or config.teacher))
    plan = TrainingPlan(
        join(start.networks), teacher_task(), header, frozen=_codec_of(start.networks)
    )
    if config.init is not None:
        header = _continued(config, header, start)
    elif config.grid is None and config.strategy == "adaptive_piecewise":
        with accelerator.main_process_first():
            found = _selection(config, flow, plan, accelerator)
        provenance |= {
            "selection": {"cost": found.cost, "uniform_cost": found.uniform_cost}
        }
        others = tuple(found.grid_of(intervals) for intervals in config.also)
        header = replace(
            header, time_grid=found.grid, other_grids=others, provenance=provenance
        )
    if config.also:
        return _student_of_several_steps(config, plan, flow, header)
    return replace(
        plan,
        task=student_task(config.strategy, flow, header.time_grid, config.steps),
        header=header,
    )


def _continued(config: DistillConfig, header: Header, start: Checkpoint) -> Header:
    """The header of a student that is trained further, with its times.

    Raises:
        ConfigError: if it is the student of another kind of teacher, or of other numbers of
            steps.
    """
    shared = ("sensor", "channels", "normalisation", "conditioning")
    differs = [k for k in shared if getattr(header, k) != getattr(start.header, k)]
    intervals = [
        len(grid) - 1 for grid in (start.header.time_grid, *start.header.other_grids)
    ]
    if differs or intervals != [config.intervals, *config.also]:
        raise ConfigError(
            f"init {config.init} with {', '.join(differs) or f'{intervals} steps'}",
            f"a student of {config.teacher} in {[config.intervals, *config.also]} steps",
        )
    made = {"init": start.hash, "init_provenance": start.header.provenance}
    return replace(
        header,
        time_grid=start.header.time_grid,
        other_grids=start.header.other_grids,
        provenance=header.provenance | made,
    )


def _check_scans(config: DistillConfig, teacher: Header) -> None:
    """Refuse the town's scans, which shipped recipes name, for a teacher of other scans.

    Raises:
        ConfigError: naming the scans that the teacher learnt from.
    """
    learnt_from = teacher.provenance.get("data")
    if (
        config.data.town is None
        or not isinstance(learnt_from, dict)
        or not learnt_from.get("path")
    ):
        return
    raise ConfigError(
        f"data.town={config.data.town} for teacher {config.teacher}, which learnt from "
        f"{learnt_from['path']}",
        "the teacher's scans",
        f"data.town=null data.path={learnt_from['path']} data.licence=LICENCE",
    )


def _student_of_several_steps(
    config: DistillConfig, plan: TrainingPlan, flow: Any, header: Header
) -> TrainingPlan:
    """The student is told where a step ends; before training, it is the teacher nevertheless."""
    networks = split(plan.network)
    held = header.networks[VELOCITY]
    if held.architecture != "hdit" or config.strategy != "adaptive_piecewise":
        raise ConfigError(
            f"also={list(config.also)} for a {held.architecture} by {config.strategy}",
            "an hdit, adaptive_piecewise",
        )
    part = held._replace(arguments=held.arguments | {"ends": True})
    networks[VELOCITY] = build_network(*part)
    networks[VELOCITY].load_state_dict(
        split(plan.network)[VELOCITY].state_dict(), strict=False
    )
    header = replace(header, networks=header.networks | {VELOCITY: part})
    task = several_steps_task(
        flow, (header.time_grid, *header.other_grids), config.steps
    )
    return replace(
        plan,
        network=join(networks),
        task=task,
        header=header,
        loss=balanced_velocity_loss,
    )


def _codec_of(networks: Mapping[str, nn.Module]) -> dict[str, nn.Module]:
    return {CODEC: networks[CODEC]} if CODEC in networks else {}


def open_data(
    config: Run,
    plan: TrainingPlan,
    device: torch.device,
    data: Data | None = None,
    folder: str = "cache",
) -> Batches:
    """The batches of the run, or of other ``data``; the scans are projected once and cached, in a
    ``folder`` of the run where the data names none."""
    given = config.data if data is None else data
    sensor = plan.header.sensor
    tensors = plan.header.tensors
    source = given.open(sensor)
    conditioning = None
    channels = set(tensors.channels)
    others = {}
    for name, options in plan.header.conditioning.items():
        condition = CONDITIONS[name]
        encoder = plan.parts(plan.network)[ENCODER]
        shape = condition.shape(encoder)
        less = options.get("view_dropout", 0.0) or options.get("outline_dropout", 0.0)
        conditioning = Conditioning(
            name, options.get("dropout", 0.0), less, getattr(encoder, "views", 1)
        )
        if condition.field == "label":  # a channel of the range image
            channels.add("label")
        else:
            others[condition.field] = Other(
                shape, _reader(name, source, sensor, shape, options)
            )
    kept = given.cache or config.output / folder
    cache = cache_scans(source, sensor, channels, kept, given.describe(), others=others)
    codec = plan.codec() if plan.autoencoder is not None else None
    batches = Batches(
        cache, tensors, config.seed, given.flip, given.roll, device, codec, conditioning
    )
    if codec is None or not given.latents:
        return batches
    made_by = network_hash(plan.parts(plan.network)[CODEC])
    return replace(
        batches, latents=cache_latents(cache, tensors, codec, device, kept, made_by)
    )


def _reader(
    name: str,
    source: Source,
    sensor: Sensor,
    shape: tuple[int, ...],
    options: dict[str, Any],
) -> Callable[[int, Scan], NDArray[np.uint8]]:
    """What reads the condition of a scan; the town renders its images when they are needed."""
    if name == "camera" and isinstance(source, Town):
        from PIL import Image

        return lambda i, scan: resize_image(
            Image.fromarray(source.image(i)), shape, options, "the town's image"
        )
    return lambda i, scan: CONDITIONS[name].read(scan, sensor, shape, options)


def _selection(
    config: DistillConfig, velocity: Any, plan: TrainingPlan, accelerator: "Accelerator"
) -> Selection:
    """The timesteps of the student; those of an earlier call with the same settings are reused."""
    path = config.output / "selection.npz"
    settings = selection_settings(config, plan.header)
    if path.exists():
        try:
            return load_selection(path, settings)
        except DataError as error:
            warnings.warn(f"{error}; the timesteps are selected again", stacklevel=2)
    conditions = (
        open_data(config, plan, accelerator.device).conditions
        if plan.header.conditioning
        else None
    )
    with accelerator.autocast():
        selection = select_timesteps(
            velocity,
            plan.codec().shape,
            config.intervals,
            metric=config.recipe.metric,
            device=accelerator.device,
            condition=conditions,
            **config.selection.model_dump(),
        )
    save_selection(path, selection, settings)
    tqdm.write(
        f"timesteps {selection.grid}: cost {selection.cost:.4g}, uniform "
        f"{selection.uniform_cost:.4g}"
    )
    return selection
