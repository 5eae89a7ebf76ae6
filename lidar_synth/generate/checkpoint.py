"""Checkpoints, "lidar-synth-checkpoint/2": one ``.safetensors`` file with weights and a JSON
header.

The header is stored in the file's metadata under ``lidar_synth`` and contains everything that
generation needs::

    format          "lidar-synth-checkpoint/2"; others are refused
    convention      "t=1 noise, t=0 data, v=noise-data": the convention of times and velocities
    networks        {part: {architecture, arguments}}; "velocity" is the flow, "codec" the
                    autoencoder of a latent model (the only part of an autoencoder's checkpoint),
                    "condition" the encoder of a condition
    sensor          the sensor, as in sensors.yaml
    normalisation   the normalisation of the range
    channels        channels of the network's data, in order, each a key of ``normalize.CHANNELS``
    label_encoding  the encoding of labels in channels, or null
    conditioning    {key of conditions.CONDITIONS: its options}; empty = unconditional. Options:
                    ``dropout``, share of blank conditions in training; ``image``, rows and columns
                    of the camera's images
    time_grid       times descending from 1 to 0: the steps that the weights were trained for
    other_grids     time grids for other numbers of steps, if there are any
    matches         {number of steps: (2, C, rows) scale and shift of its states}, which gives them
                    the moments of the states of ``time_grid``
    provenance      ``data``, ``data_licence`` and ``licence`` (of the weights) at least; teacher,
                    recipe, metrics
    weights         sha256 of all tensors
    checksum        sha256 of all other keys, as JSON with sorted keys

A tensor's name is its part, a dot, and its name in the network. The hash of a checkpoint is its
checksum, which covers the header and, through ``weights``, the tensors. Nothing is ever unpickled.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from lidar_synth.errors import ConfigError, DataError, parsing
from lidar_synth.files.disk import open_file, write_file
from lidar_synth.generate.conditions import CONDITIONS, Conditioned
from lidar_synth.generate.devices import check_device
from lidar_synth.generate.flow.solvers import read_grid, uniform_grid
from lidar_synth.generate.models import assemble
from lidar_synth.geometry import Sensor
from lidar_synth.geometry.normalize import LABEL_BITS, Normalisation, TensorFormat

FORMAT = "lidar-synth-checkpoint/2"
CONVENTION = "t=1 noise, t=0 data, v=noise-data"
LABEL_ENCODING = f"{LABEL_BITS} analog bits, most significant first, code 19 = no label"
VELOCITY = "velocity"
CODEC = "codec"
ENCODER = "condition"
"""Names of the parts: the flow's velocity network, the autoencoder, the encoder of the
condition."""

_MOST_DIMENSIONS = 8  # torch computes with up to 64


class NetworkSpec(NamedTuple):
    """The arguments of ``models.build_network``."""

    architecture: str
    arguments: dict[str, Any]


@dataclass(frozen=True)
class Header:
    """The header of a checkpoint; the module's docstring describes its fields.

    Raises:
        ConfigError: on invalid networks, channels, time grids, matches, provenance or conditioning.
    """

    networks: dict[str, NetworkSpec]
    sensor: Sensor
    normalisation: Normalisation
    channels: tuple[str, ...]
    time_grid: tuple[float, ...]
    provenance: dict[str, Any]
    conditioning: dict[str, Any] = field(default_factory=dict)
    other_grids: tuple[tuple[float, ...], ...] = ()
    matches: dict[str, list[Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not {VELOCITY, CODEC} & set(self.networks):
            raise ConfigError(
                f"networks {sorted(self.networks)}",
                f"{VELOCITY!r} or {CODEC!r} among them",
            )
        for grid in (self.time_grid, *self.other_grids):
            read_grid(grid)
        for steps, match in self.matches.items():
            if steps not in {str(len(grid) - 1) for grid in self.other_grids}:
                raise ConfigError(
                    f"matches for {steps!r} steps", "numbers of steps of other_grids"
                )
            _check_match(match)
        if missing := [
            k for k in ("data", "data_licence", "licence") if not self.provenance.get(k)
        ]:
            raise ConfigError(
                f"a provenance without {', '.join(missing)}",
                "data, data_licence and licence",
            )
        if unknown := sorted(set(self.conditioning) - set(CONDITIONS)):
            raise ConfigError(
                f"conditioning on {unknown}", f"some of {', '.join(CONDITIONS)}"
            )
        shape = (self.tensors.size, *self.sensor.shape)
        # The network that takes range images has the grid of the sensor.
        name = CODEC if CODEC in self.networks else VELOCITY
        arguments = self.networks[name].arguments
        network = (
            arguments.get("channels", shape[0]),
            *arguments.get("resolution", shape[1:]),
        )
        if network != shape:
            raise ConfigError(
                f"a network for {network} channels, rows and columns",
                f"{shape}: channels {self.channels} on sensor {self.sensor.name!r}",
            )

    @property
    def tensors(self) -> TensorFormat:
        """The format of the network's tensors."""
        return TensorFormat(self.channels, self.normalisation)

    def grid(self, steps: int | None) -> tuple[float, ...]:
        """The time grid for a number of steps: the header's if it has one, else a uniform one; None
        = ``time_grid``.

        Raises:
            ConfigError: on fewer than one step.
        """
        known = {len(grid) - 1: grid for grid in (*self.other_grids, self.time_grid)}
        return (
            self.time_grid if steps is None else known.get(steps) or uniform_grid(steps)
        )

    def match(self, state: Tensor, grid: Sequence[float]) -> Tensor:
        """The result (B, C, rows, columns) of a time grid, scaled and shifted towards the moments
        of those of ``time_grid``, where these were measured."""
        steps = len(grid) - 1
        if str(steps) not in self.matches or grid != self.grid(steps):
            return state
        scale, shift = state.new_tensor(self.matches[str(steps)])[..., None]
        matched: Tensor = state * scale + shift
        return matched

    def to_dict(self) -> dict[str, Any]:
        """Plain values, as the file stores them, without ``weights`` and ``checksum``."""
        values = {
            "format": FORMAT,
            "convention": CONVENTION,
            "networks": {name: part._asdict() for name, part in self.networks.items()},
            "sensor": self.sensor.to_dict(),
            "normalisation": self.normalisation.to_dict(),
            "channels": list(self.channels),
            "label_encoding": LABEL_ENCODING if "label" in self.channels else None,
            "conditioning": self.conditioning,
            "time_grid": list(self.time_grid),
            "provenance": self.provenance,
        }
        more = {
            "other_grids": list(map(list, self.other_grids)),
            "matches": self.matches,
        }
        return values | {key: value for key, value in more.items() if value}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "Header":
        """The inverse of ``to_dict``.

        Raises:
            ConfigError: on another format, or on unknown, missing or invalid keys and values.
        """
        values = dict(values)
        if (given := values.pop("format", None)) != FORMAT:
            raise ConfigError(
                f"format {given!r}",
                repr(FORMAT),
                "Use the version of lidar_synth that wrote the file.",
            )
        try:
            header = cls(
                networks={
                    name: NetworkSpec(**part)
                    for name, part in values["networks"].items()
                },
                sensor=Sensor.from_dict(values["sensor"]),
                normalisation=Normalisation(**values["normalisation"]),
                channels=tuple(values["channels"]),
                time_grid=tuple(map(float, values["time_grid"])),
                provenance=dict(values["provenance"]),
                conditioning=dict(values["conditioning"]),
                other_grids=tuple(
                    tuple(map(float, grid)) for grid in values.get("other_grids", ())
                ),
                matches=dict(values.get("matches", {})),
            )
        except KeyError as error:
            raise ConfigError(
                f"a header without {error}", "all keys of the format"
            ) from error
        except (TypeError, AttributeError, OverflowError) as error:
            raise ConfigError(
                f"a header with invalid values ({error})", "the values of the format"
            ) from error
        expected = header.to_dict()
        if unknown := sorted(set(values) - set(expected)):
            raise ConfigError(f"header keys {unknown}", f"those of {FORMAT}")
        for key in ("convention", "label_encoding"):
            if values.get(key) != expected[key]:
                raise ConfigError(f"{key} {values.get(key)!r}", repr(expected[key]))
        return header


def _check_match(match: Any) -> None:
    try:
        values = torch.tensor(match, dtype=torch.float32)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        values = torch.empty(0)
    if values.dim() != 3 or len(values) != 2 or not values.isfinite().all():
        raise ConfigError(
            "matches of another shape or with invalid values",
            "(2, C, rows) finite numbers for each number of steps",
        )


def join(networks: Mapping[str, nn.Module]) -> nn.Module:
    """The flow of a checkpoint's networks as one v(y, t, c), which takes conditions as they are
    stored."""
    velocity = networks[VELOCITY]
    return Conditioned(velocity, networks[ENCODER]) if ENCODER in networks else velocity


def split(network: nn.Module) -> dict[str, nn.Module]:
    """The inverse of ``join``."""
    if isinstance(network, Conditioned):
        return {VELOCITY: network.velocity, ENCODER: network.encoder}
    return {VELOCITY: network}


class Checkpoint(NamedTuple):
    """A loaded checkpoint.

    Args:
        header: its header.
        networks: its networks by part, in evaluation mode, float32.
        hash: sha256 of the header and, through it, of the weights, in hexadecimal.
    """

    header: Header
    networks: dict[str, nn.Module]
    hash: str


def save_checkpoint(
    path: Path,
    header: Header,
    networks: Mapping[str, nn.Module],
    dtype: torch.dtype | None = None,
) -> str:
    """Write a checkpoint to a temporary file, then rename it; the same content gives the same
    bytes.

    Args:
        path: path that ends in ``.safetensors``.
        header: header whose ``networks`` describe those given.
        networks: networks by part.
        dtype: dtype of the stored parameters; buffers keep theirs.

    Returns:
        The checkpoint's hash.

    Raises:
        ConfigError: on another suffix, or if header and networks differ.
        DataError: on weights that are not finite.
        FileError: if the file cannot be written.
    """
    path = Path(path)
    if path.suffix != ".safetensors":
        raise ConfigError(f"checkpoint {path}", "a name that ends in .safetensors")
    if set(networks) != set(header.networks):
        raise ConfigError(
            f"networks {sorted(networks)}",
            f"those of the header: {sorted(header.networks)}",
        )
    tensors = {}
    for name, network in networks.items():
        state = {k: v.detach().cpu() for k, v in network.state_dict().items()}
        assemble(*header.networks[name], state, f"the network {name!r}")
        parameters = dict(network.named_parameters())
        for key, tensor in state.items():
            tensors[f"{name}.{key}"] = tensor.to(
                dtype if key in parameters else None
            ).contiguous()
    _check_finite(tensors, "the network")
    values = {**header.to_dict(), "weights": weights_hash(tensors)}
    try:
        checksum = _checksum(values)
    except (TypeError, ValueError) as error:
        raise ConfigError(
            f"a header with a value that JSON cannot store ({error})",
            "plain, finite values",
        ) from error
    text = json.dumps({**values, "checksum": checksum}, sort_keys=True)
    write_file(path, save(tensors, {"lidar_synth": text}), durable=True)
    return checksum


def load_checkpoint(path: Path, device: torch.device | str = "cpu") -> Checkpoint:
    """Read a checkpoint and build its networks.

    Args:
        path: file written by ``save_checkpoint``.
        device: device of the networks.

    Raises:
        ConfigError: on an unavailable device.
        FileError: if the file cannot be read.
        DataError: on a file that is not a checkpoint of this version, is truncated or damaged, or
            whose weights do not match its header.
    """
    device = check_device(device)
    header, digest, weights, tensors = _read(Path(path))
    if weights != weights_hash(tensors):
        raise DataError(
            f"{path}: the weights do not match their checksum in the header",
            "an intact file",
            "Copy it again.",
        )
    _check_finite(tensors, str(path))
    networks = {}
    for name, part in header.networks.items():
        # Copies are aligned in memory; the file's buffer is not, which changes the last bits of
        # matrix products.
        state = {
            k.removeprefix(f"{name}."): v.clone()
            for k, v in tensors.items()
            if k.startswith(f"{name}.")
        }
        networks[name] = assemble(*part, state, f"{path}: the network {name!r}", device)
    if unknown := [k for k in tensors if k.partition(".")[0] not in header.networks]:
        raise DataError(
            f"{path}: tensors {unknown}", f"those of {sorted(header.networks)} only"
        )
    return Checkpoint(header, networks, digest)


def read_header(path: Path) -> tuple[Header, str]:
    """The header of a checkpoint and its hash, without its weights.

    Raises the errors of ``load_checkpoint``.
    """
    content = _read(Path(path), tensors=False)
    return content.header, content.hash


class _Content(NamedTuple):
    """The content of a checkpoint file; ``weights`` is the checksum of the tensors that the header
    states."""

    header: Header
    hash: str
    weights: Any
    tensors: dict[str, Tensor]


def _read(path: Path, tensors: bool = True) -> _Content:
    """The content of a checkpoint with a verified header; the tensors are not verified yet."""
    with open_file(path, "a .safetensors file") as file:
        start = file.read(2)
    if start in (b"PK", b"\x80\x02"):
        raise DataError(
            f"{path} is a PyTorch pickle",
            "a .safetensors checkpoint",
            "A pickle can run code and is never loaded as a checkpoint. To convert weights of "
            f"R2Flow or LiDM: lidar-synth import {path} OUT.safetensors (--peer lidm for LiDM's)",
        )
    try:
        with safe_open(path, framework="pt") as content:
            text = (content.metadata() or {}).get("lidar_synth")
            keys = content.keys() if tensors else ()
            stored = {key: content.get_tensor(key) for key in keys}
    except SafetensorError as error:
        raise DataError(
            f"{path} is truncated, damaged or no .safetensors file ({error})",
            "an intact file",
            "Copy it again.",
        ) from error
    if text is None:
        raise DataError(
            f"{path} has weights but no header of lidar_synth", f"a file of {FORMAT}"
        )
    with parsing(path):
        values = json.loads(text)
        digest = _verified(values)
        weights = values.pop("weights", None)
        return _Content(Header.from_dict(values), digest, weights, stored)


def _verified(values: dict[str, Any]) -> str:
    """Remove the checksum from a header's values and return it; raise a ConfigError if it does not
    match."""
    checksum = values.pop("checksum", None)
    if values.get("format") == FORMAT and checksum != _checksum(values):
        raise ConfigError(
            "a header that does not match its checksum",
            "an intact file",
            "Copy it again.",
        )
    return str(checksum)


def _checksum(values: Mapping[str, Any]) -> str:
    """sha256 of plain values, independent of the order of keys."""
    text = json.dumps(values, sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def _check_finite(tensors: Mapping[str, Tensor], what: str) -> None:
    """Raise a DataError on values that are complex, or not finite in float32, or of too many
    dimensions."""
    if deep := [k for k, v in tensors.items() if v.dim() > _MOST_DIMENSIONS]:
        raise DataError(
            f"{what} has tensors of more than {_MOST_DIMENSIONS} dimensions: {deep}",
            "weights",
        )
    if bad := [
        k
        for k, v in tensors.items()
        if v.is_complex() or not torch.isfinite(v.float()).all()
    ]:
        raise DataError(
            f"{what} has NaN or infinity in {bad}", "finite weights and ray angles"
        )


def network_hash(network: nn.Module) -> str:
    """``weights_hash`` of a network's state, on any device."""
    return weights_hash(
        {key: value.cpu() for key, value in network.state_dict().items()}
    )


def weights_hash(tensors: Mapping[str, Tensor]) -> str:
    """sha256 of the names, dtypes, shapes and bytes of tensors on the CPU, in hexadecimal."""
    digest = hashlib.sha256()
    for key in sorted(tensors):
        tensor = tensors[key]
        digest.update(f"{key} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()
