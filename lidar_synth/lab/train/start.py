"""What a training run starts with: fresh networks, or those of a checkpoint, and the header of what
will come of it."""

import json
import os
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import nn

from lidar_synth.datasets.recordings import Recordings, inherited
from lidar_synth.errors import ConfigError
from lidar_synth.formats import BankScans, ScanFiles, layout_of
from lidar_synth.generate.checkpoint import (
    CODEC,
    ENCODER,
    VELOCITY,
    Header,
    NetworkSpec,
    load_checkpoint,
)
from lidar_synth.generate.codec import make_codec
from lidar_synth.generate.flow.solvers import uniform_grid
from lidar_synth.generate.loading import find_model
from lidar_synth.generate.models import build_network, network_class
from lidar_synth.geometry.sensor import Sensor, load_sensor
from lidar_synth.lab.evaluate.leakage import recordings_of, town
from lidar_synth.lab.train.config import (
    PARENTS,
    ConditionSection,
    Data,
    NetworkSection,
    Run,
    TrainConfig,
)


def fresh_networks(config: TrainConfig) -> tuple[dict[str, nn.Module], Header]:
    """New networks and the header that describes them."""
    provenance = provenance_of(config)
    if config.codec is not None:
        codec = load_checkpoint(config.codec)
        if CODEC not in codec.networks:
            raise ConfigError(
                f"codec {config.codec}", "the checkpoint of an autoencoder"
            )
        _check_held(
            config, codec.header, ("sensor", "channels", "normalisation"), config.codec
        )
        sensor = codec.header.sensor
        tensors = codec.header.tensors
        fixed = {CODEC: codec.header.networks[CODEC]}
        state = make_codec(codec.networks[CODEC], tensors, sensor.shape).shape
        provenance |= {"codec": codec.hash, "codec_provenance": codec.header.provenance}
    else:
        sensor = load_sensor(config.sensor)
        tensors = config.tensors()
        fixed = {}
        state = (tensors.size, *sensor.shape)
    parts = config.parts(state, sensor.shape)
    networks = _build(config, parts, sensor, state)
    header = Header(
        networks=parts | fixed,
        sensor=sensor,
        normalisation=tensors.normalisation,
        channels=tensors.channels,
        time_grid=uniform_grid(1 if config.autoencodes else config.steps),
        provenance=provenance,
        conditioning={config.condition.kind: config.condition.options()}
        if config.condition
        else {},
    )
    return networks, header


def start_networks(config: TrainConfig) -> tuple[dict[str, nn.Module], Header]:
    """The networks of ``config.init``, and its header for the new run."""
    assert config.init is not None
    start = load_checkpoint(find_model(config.init))
    wanted = (
        {CODEC, VELOCITY}
        if config.decoder
        else {CODEC if config.autoencodes else VELOCITY}
    )
    if not wanted <= set(start.networks) or config.codec is not None:
        raise ConfigError(
            f"init {config.init} with parts {sorted(start.networks)}",
            "a checkpoint of the same kind",
        )
    _check_held(
        config,
        start.header,
        ("sensor", "channels", "normalisation", "network"),
        config.init,
    )
    provenance = provenance_of(config) | {
        "init": start.hash,
        "init_provenance": start.header.provenance,
    }
    grid = (
        start.header.time_grid
        if config.autoencodes or config.decoder
        else uniform_grid(config.steps)
    )
    networks = {CODEC: start.networks[CODEC]} if config.autoencodes else start.networks
    kept = {name: start.header.networks[name] for name in networks}
    conditioning = {} if config.autoencodes else start.header.conditioning
    header = replace(
        start.header,
        networks=kept,
        time_grid=grid,
        provenance=provenance,
        conditioning=conditioning,
    )
    if not (config.autoencodes or config.decoder):
        networks, header = _without_ends(networks, header)
    if config.condition is None or config.autoencodes:
        return networks, header
    if ENCODER in networks:
        return networks, _same_condition(config, config.condition, header)
    return _add_condition(config, networks, header)


def _same_condition(
    config: TrainConfig, condition: ConditionSection, header: Header
) -> Header:
    """The header of a conditional model that is trained further, with the shares of ``condition``
    that are given.

    Raises:
        ConfigError: if the model has another condition.
    """
    [(kind, held)] = header.conditioning.items()
    encoder = header.networks[ENCODER]
    known = {
        "kind": kind,
        "encoder": encoder.architecture,
        "arguments": encoder.arguments,
    } | held
    given = {
        name: value
        for name, value in condition
        if name in condition.model_fields_set and value is not None
    }
    shares = {name: value for name, value in given.items() if name.endswith("dropout")}
    if isinstance(
        given.get("arguments"), dict
    ):  # those that a configuration names: sizes follow from the data
        known["arguments"] = {
            name: known["arguments"].get(name) for name in given["arguments"]
        }
    for name in sorted(given.keys() - shares.keys()):
        value = list(given[name]) if isinstance(given[name], tuple) else given[name]
        if value != known.get(name):
            raise ConfigError(
                f"condition.{name} {value!r} for init {config.init}",
                f"that of the model, {known.get(name)!r}",
            )
    changed = {name: value for name, value in (held | shares).items() if value}
    return replace(header, conditioning={kind: changed})


def _without_ends(
    networks: dict[str, nn.Module], header: Header
) -> tuple[dict[str, nn.Module], Header]:
    """A student of several numbers of steps as the start of a flow, which is not told where a step
    ends."""
    held = header.networks[VELOCITY]
    if not held.arguments.get("ends"):
        return networks, header
    part = held._replace(
        arguments={
            name: value for name, value in held.arguments.items() if name != "ends"
        }
    )
    velocity = build_network(*part)
    velocity.load_state_dict(
        {
            k: v
            for k, v in networks[VELOCITY].state_dict().items()
            if not k.startswith("step.")
        }
    )
    return networks | {VELOCITY: velocity}, replace(
        header, networks=header.networks | {VELOCITY: part}, other_grids=()
    )


def _add_condition(
    config: TrainConfig, networks: dict[str, nn.Module], header: Header
) -> tuple[dict[str, nn.Module], Header]:
    """An unconditional model as the start of a conditional one: it generates what it did, and
    learns to look."""
    assert config.condition is not None
    held = header.networks[VELOCITY]
    derived = network_class(held.architecture).derived_arguments
    own = {name: value for name, value in held.arguments.items() if name not in derived}
    asked = config.model_copy(
        update={
            "network": NetworkSection(architecture=held.architecture, arguments=own)
        }
    )
    state = make_codec(networks.get(CODEC), header.tensors, header.sensor.shape).shape
    parts = asked.parts(state, header.sensor.shape)
    made = _build(config, parts, header.sensor, state)
    try:
        new = made[VELOCITY].load_state_dict(
            networks[VELOCITY].state_dict(), strict=False
        )
    except RuntimeError as error:
        raise ConfigError(
            f"a condition for init {config.init}, a {held.architecture}",
            "init: a model of this condition, or an unconditional hdit",
        ) from error
    assert not new.unexpected_keys and all(
        "condition" in k or "context" in k for k in new.missing_keys
    ), new
    conditioning: dict[str, Any] = {config.condition.kind: config.condition.options()}
    return networks | made, replace(
        header, networks=header.networks | parts, conditioning=conditioning
    )


def _build(
    config: TrainConfig,
    parts: dict[str, NetworkSpec],
    sensor: Sensor,
    state: tuple[int, int, int],
) -> dict[str, nn.Module]:
    """Networks with fresh weights, some of which look where the cells of the state look."""
    torch.manual_seed(config.seed)
    angles = torch.from_numpy(sensor.ray_angles(config.rays))
    pooled = F.avg_pool2d(
        angles[None], (sensor.shape[0] // state[1], sensor.shape[1] // state[2])
    )[0]
    networks: dict[str, nn.Module] = {}
    for name, part in parts.items():
        needed = (
            {"angles": pooled}
            if network_class(part.architecture).needs_ray_angles
            else {}
        )
        networks[name] = build_network(part.architecture, part.arguments | needed)
    return networks


def _check_held(
    config: TrainConfig, header: Header, keys: tuple[str, ...], path: Any
) -> None:
    """What the configuration says, if it says it, has to be what the checkpoint holds."""
    part = header.networks[
        CODEC if config.autoencodes or "network" not in keys else VELOCITY
    ]
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
        "network": {
            "architecture": config.network.architecture,
            "arguments": arguments,
        },
    }
    for key in set(keys) & config.model_fields_set:
        if json.dumps(asked[key], sort_keys=True) != json.dumps(
            held[key], sort_keys=True
        ):
            raise ConfigError(
                f"{key} {asked[key]}",
                f"that of {path}: {held[key]}",
                f"Or leave out {key}.",
            )


def add_recordings(config: Run, header: Header) -> Header:
    """The header with all recordings that the weights will know: of this run and of what it begins
    with.

    Raises:
        FileError, DataError: where the scans cannot be opened.
    """
    seen = inherited(header.provenance) | _recordings(config.data, header.sensor)
    if config.held_out is not None:  # they chose the weights
        seen |= _recordings(config.held_out.data, header.sensor)
    if config.rehearsal is not None:
        seen |= _recordings(config.rehearsal, header.sensor)
    return replace(header, provenance=header.provenance | {"seen": seen.to_list()})


def _recordings(data: Data, sensor: Sensor) -> Recordings:
    if data.seen is not None:
        return Recordings.from_list(data.seen)
    if data.path is None:
        return town(data.seed)
    source = data.open(sensor)
    assert isinstance(source, ScanFiles)
    if isinstance(source, BankScans):  # maybe at a URL, which has no layout to look for
        return recordings_of(source, "bank", data.path)
    return recordings_of(
        source, data.layout or layout_of(Path(os.path.expandvars(data.path))), data.path
    )


def provenance_of(config: Run) -> dict[str, Any]:
    """What a checkpoint says of its making; the checkpoints that it was made from stand beside, by
    their hash."""
    beside = {
        "output",
        "data",
        "licence",
        "samples",
        "save_every",
        "sensor",
        "held_out",
        "rehearsal",
        *PARENTS,
    }
    more = (
        {} if config.rehearsal is None else {"rehearsal": config.rehearsal.describe()}
    )
    return more | {
        "data": config.data.describe(),
        "data_licence": config.data.licence,
        "licence": config.licence,
        "recipe": config.model_dump(mode="json", exclude=beside),
        "software": f"lidar_synth {version('lidar_synth')}, torch {torch.__version__}",
    }
