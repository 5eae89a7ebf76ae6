"""What a training run starts with: fresh networks, or those of a checkpoint, and the header of what
will come of it."""

import json
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import nn

from lidar_synth.errors import ConfigError
from lidar_synth.generate.checkpoint import (
    CODEC,
    ENCODER,
    VELOCITY,
    Checkpoint,
    Header,
    NetworkSpec,
    load_checkpoint,
)
from lidar_synth.generate.codec import make_codec
from lidar_synth.generate.flow.solvers import uniform_grid
from lidar_synth.generate.loading import find_model
from lidar_synth.generate.models import build_network, network_class
from lidar_synth.geometry import Sensor, load_sensor
from lidar_synth.geometry.normalize import Normalisation
from lidar_synth.lab.train.config import (
    ConditionSection,
    NetworkSection,
    TrainConfig,
)
from lidar_synth.lab.train.provenance import provenance_of

Opened = tuple[dict[str, nn.Module], Header]
"""Networks, and the header that describes them."""


def open_networks(config: TrainConfig) -> Opened:
    """Those of ``config.init``, or new ones.

    Raises:
        ConfigError: where the configuration does not fit the checkpoints that it names.
        FileError, DataError: where they cannot be read.
    """
    if config.init is not None:
        torch.manual_seed(config.seed)  # of what the checkpoint lacks
        return start_networks(config, config.init)
    return fresh_networks(config)


def fresh_networks(config: TrainConfig) -> Opened:
    """New networks and the header that describes them."""
    provenance = provenance_of(config)
    if config.codec is None:
        whole = load_sensor(config.sensor)
        tensors = config.tensors()
        sensor = limit_ranges(whole, tensors.normalisation)
        if sensor != whole:
            warnings.warn(
                f"sensor {whole.name!r} from {whole.range_min:g} to {whole.range_max:g} m: only "
                f"returns from {sensor.range_min:g} to {sensor.range_max:g} m are learnt, those of "
                f"the normalisation {config.normalisation!r}",
                stacklevel=2,
            )
        fixed = {}
        networks: dict[str, nn.Module] = {}
        state = (tensors.size, *sensor.shape)
    else:
        codec = _load_codec(config.codec)
        held = codec.header
        _check_held(config, held, config.codec)
        sensor = held.sensor
        tensors = held.tensors
        fixed = {CODEC: held.networks[CODEC]}
        networks = {CODEC: codec.networks[CODEC]}
        state = make_codec(networks[CODEC], tensors, sensor.shape).shape
        provenance |= {"codec": codec.hash, "codec_provenance": held.provenance}
    parts = config.parts(state, sensor.shape)
    header = Header(
        networks=parts | fixed,
        sensor=sensor,
        normalisation=tensors.normalisation,
        channels=tensors.channels,
        time_grid=uniform_grid(1 if config.autoencodes else config.steps),
        provenance=provenance,
        conditioning=_conditioning(config.condition),
    )
    return networks | _build(config, parts, sensor, state), header


def limit_ranges(sensor: Sensor, normalisation: Normalisation) -> Sensor:
    """A sensor with the ranges that a normalisation holds.

    Raises:
        ConfigError: if they have nothing in common.
    """
    near = max(sensor.range_min, normalisation.range_min)
    far = min(sensor.range_max, normalisation.range_max)
    if near >= far:
        raise ConfigError(
            f"sensor {sensor.name!r} from {sensor.range_min} to {sensor.range_max} m",
            f"some of {normalisation.range_min} to {normalisation.range_max} m, "
            "the model's ranges",
        )
    return replace(sensor, range_min=near, range_max=far)


def _load_codec(path: Path) -> Checkpoint:
    """A checkpoint with an autoencoder."""
    codec = load_checkpoint(path)
    if CODEC not in codec.networks:
        raise ConfigError(f"codec {path}", "the checkpoint of an autoencoder")
    return codec


def _conditioning(condition: ConditionSection | None) -> dict[str, dict[str, Any]]:
    """What a header says of a condition."""
    return {} if condition is None else {condition.kind: condition.options()}


def start_networks(config: TrainConfig, init: Path) -> Opened:
    """The networks of ``init``, and its header for the new run."""
    start = load_checkpoint(find_model(init))
    name = CODEC if config.autoencodes else VELOCITY
    wanted = {CODEC, VELOCITY} if config.decoder else {name}
    if not wanted <= set(start.networks):
        raise ConfigError(
            f"init {init} with parts {sorted(start.networks)}",
            "a checkpoint of the same kind",
        )
    _check_held(config, start.header, init, name)
    facts = {"init": start.hash, "init_provenance": start.header.provenance}
    header = replace(start.header, provenance=provenance_of(config) | facts)
    networks = start.networks
    if config.autoencodes:
        kept = {CODEC: header.networks[CODEC]}
        networks = {CODEC: networks[CODEC]}
        return networks, replace(header, networks=kept, conditioning={})
    if config.decoder:
        return networks, header
    if config.codec is not None:
        networks, header = _change_codec(config.codec, networks, header)
    header = replace(header, time_grid=uniform_grid(config.steps))
    networks, header = _drop_ends(networks, header)
    if config.condition is None:
        return networks, header
    if ENCODER in networks:
        return networks, _same_condition(config.condition, init, header)
    return _add_condition(config, networks, header)


def _change_codec(path: Path, networks: dict[str, nn.Module], header: Header) -> Opened:
    """A latent model on the latents of another autoencoder, such as its own trained further.

    Raises:
        ConfigError: on an autoencoder of other scans or of latents of another shape.
    """
    codec = _load_codec(path)
    facts = [_latents_of(networks, header), _latents_of(codec.networks, codec.header)]
    differs = [key for key in facts[0] if facts[0][key] != facts[1][key]]
    if differs:
        raise ConfigError(
            f"codec {path} of another {', '.join(differs)} than init",
            "an autoencoder with the latents of init",
        )
    made = {"codec": codec.hash, "codec_provenance": codec.header.provenance}
    header = replace(
        header,
        networks=header.networks | {CODEC: codec.header.networks[CODEC]},
        provenance=header.provenance | made,
    )
    return networks | {CODEC: codec.networks[CODEC]}, header


def _latents_of(networks: dict[str, nn.Module], header: Header) -> dict[str, Any]:
    """What an autoencoder encodes, and the shape of what it makes of it."""
    codec = make_codec(networks.get(CODEC), header.tensors, header.sensor.shape)
    return {
        "sensor": header.sensor,
        "channels": header.channels,
        "normalisation": header.normalisation,
        "shape of latents": codec.shape,
    }


def _same_condition(condition: ConditionSection, init: Path, header: Header) -> Header:
    """The header of a conditional model that is trained further, with the shares of ``condition``
    that are given.

    Raises:
        ConfigError: if the model has another condition.
    """
    [(kind, held)] = header.conditioning.items()
    encoder = header.networks[ENCODER]
    known = {"kind": kind, "encoder": encoder.architecture, **held}
    shares = {}
    given = condition.model_dump(mode="json", exclude_unset=True, exclude_none=True)
    # Sizes among the arguments follow from the data.
    for name, value in given.pop("arguments", {}).items():
        given[f"arguments.{name}"] = value
        known[f"arguments.{name}"] = encoder.arguments.get(name)
    for name, value in given.items():
        if name.endswith("dropout"):
            shares[name] = value
        elif value != known.get(name):
            raise ConfigError(
                f"condition.{name} {value!r} for init {init}",
                f"that of the model, {known.get(name)!r}",
            )
    changed = {name: value for name, value in (held | shares).items() if value}
    return replace(header, conditioning={kind: changed})


def _drop_ends(networks: dict[str, nn.Module], header: Header) -> Opened:
    """A student of several numbers of steps as the start of a flow, which is not told where a step
    ends."""
    held = header.networks[VELOCITY]
    if not held.arguments.get("ends"):
        return networks, header
    arguments = dict(held.arguments)
    del arguments["ends"]
    part = held._replace(arguments=arguments)
    velocity = build_network(*part)
    weights = networks[VELOCITY].state_dict()
    kept = {name: w for name, w in weights.items() if not name.startswith("step.")}
    velocity.load_state_dict(kept)
    parts = header.networks | {VELOCITY: part}
    header = replace(header, networks=parts, other_grids=(), matches={})
    return networks | {VELOCITY: velocity}, header


def _add_condition(
    config: TrainConfig, networks: dict[str, nn.Module], header: Header
) -> Opened:
    """An unconditional model as the start of a conditional one: it generates what it did, and
    learns to look."""
    held = header.networks[VELOCITY]
    derived = network_class(held.architecture).derived_arguments
    own = {name: value for name, value in held.arguments.items() if name not in derived}
    section = NetworkSection(architecture=held.architecture, arguments=own)
    asked = config.model_copy(update={"network": section})
    state = make_codec(networks.get(CODEC), header.tensors, header.sensor.shape).shape
    parts = asked.parts(state, header.sensor.shape)
    made = _build(config, parts, header.sensor, state)
    weights = networks[VELOCITY].state_dict()
    try:
        new = made[VELOCITY].load_state_dict(weights, strict=False)
    except RuntimeError as error:
        raise ConfigError(
            f"a condition for init {config.init}, a {held.architecture}",
            "init: a model of this condition, or an unconditional hdit",
        ) from error
    assert not new.unexpected_keys and all(
        "condition" in k or "context" in k for k in new.missing_keys
    ), new
    header = replace(
        header,
        networks=header.networks | parts,
        conditioning=_conditioning(config.condition),
    )
    return networks | made, header


def _build(
    config: TrainConfig,
    parts: dict[str, NetworkSpec],
    sensor: Sensor,
    state: tuple[int, int, int],
) -> dict[str, nn.Module]:
    """Networks with fresh weights, some of which look where the cells of the state look."""
    torch.manual_seed(config.seed)
    angles = torch.from_numpy(sensor.ray_angles(config.rays))
    rows, columns = sensor.shape
    pooled = F.avg_pool2d(angles[None], (rows // state[1], columns // state[2]))[0]
    networks: dict[str, nn.Module] = {}
    for name, part in parts.items():
        arguments = dict(part.arguments)
        if network_class(part.architecture).needs_ray_angles:
            arguments["angles"] = pooled
        networks[name] = build_network(part.architecture, arguments)
    return networks


def _check_held(
    config: TrainConfig, header: Header, path: Path, network: str = ""
) -> None:
    """What the configuration says, if it says it, has to be what the checkpoint holds: sensor,
    channels, normalisation, and the part ``network``."""
    limits = header.normalisation
    held: dict[str, Any] = {
        "sensor": limit_ranges(header.sensor, limits).to_dict(),
        "channels": header.channels,
        "normalisation": limits.to_dict(),
    }
    asked: dict[str, Any] = {
        "sensor": limit_ranges(load_sensor(config.sensor), limits).to_dict(),
        "channels": config.channels,
        "normalisation": config.tensors().normalisation.to_dict(),
    }
    if network:
        held["network"] = header.networks[network]._asdict()
        asked["network"] = config.network.model_dump()
        given = header.networks[network].arguments | config.network.arguments
        asked["network"]["arguments"] = given
    for key in held.keys() & config.model_fields_set:
        if _as_json(asked[key]) != _as_json(held[key]):
            raise ConfigError(
                f"{key} {asked[key]}",
                f"that of {path}: {held[key]}",
                f"Or leave out {key}.",
            )


def _as_json(value: Any) -> str:
    return json.dumps(value, sort_keys=True)
