"""Checkpoints, "lidar-synth-checkpoint/2": one ``.safetensors`` with weights and a JSON header.

The header stands in the file's metadata under ``lidar_synth`` and says all that generation needs::

    format          "lidar-synth-checkpoint/2"; "/1" is read too, every other one is refused
    convention      "t=1 noise, t=0 data, v=noise-data", so that nobody has to guess
    networks        {part: {architecture, arguments}}; "velocity" is the flow, "codec" the autoencoder of a latent
                    model (an autoencoder alone has this part only), "condition" the encoder of a condition
    sensor          as in sensors.yaml
    normalisation   of the range
    channels        of the network's data, in order, each a name of ``normalize.CHANNELS``
    label_encoding  how labels are written into channels, or null
    conditioning    {name of conditions.CONDITIONS: its options}; empty = unconditional. Options: ``dropout``, share of
                    blank conditions in training; ``image``, rows and columns of the camera's images
    time_grid       descending from 1 to 0: the steps that the weights were made for
    provenance      ``data``, ``data_licence`` and ``licence`` (of the weights) at least; teacher, recipe, metrics
    weights         sha256 of all tensors
    checksum        sha256 of all other keys, as JSON with sorted keys

A tensor's name is its part, a dot, and its name in the network. The hash of a checkpoint is its checksum, which covers
the header and, through ``weights``, the tensors. Version 1 has no checksum: its hash is the sha256 of the header's
text, and a changed byte of its header can go unnoticed. Nothing is ever unpickled.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from lidar_synth.errors import ConfigError, DataError, FileError
from lidar_synth.files.disk import write_file
from lidar_synth.generate.conditions import CONDITIONS, Conditioned
from lidar_synth.generate.devices import checked_device
from lidar_synth.geometry.normalize import LABEL_BITS, Normalisation, TensorFormat
from lidar_synth.geometry.sensor import Sensor
from lidar_synth.models import assemble

FORMAT = "lidar-synth-checkpoint/2"
WITHOUT_CHECKSUM = "lidar-synth-checkpoint/1"
"""The older format, whose header no checksum covers; it is read, and no longer written."""
CONVENTION = "t=1 noise, t=0 data, v=noise-data"
LABEL_ENCODING = f"{LABEL_BITS} analog bits, most significant first, code 19 = no label"
VELOCITY, CODEC, ENCODER = "velocity", "codec", "condition"
"""Parts: the flow's velocity network, the autoencoder, the encoder of the condition."""


class NetworkSpec(NamedTuple):
    """A network as ``nets.build_network`` takes it."""

    architecture: str
    arguments: dict[str, Any]


@dataclass(frozen=True)
class Header:
    """What a checkpoint says about its weights; the fields are those of the module's docstring.

    Raises:
        ConfigError: on channels, a time grid or a provenance that no checkpoint may have.
    """

    networks: dict[str, NetworkSpec]
    sensor: Sensor
    normalisation: Normalisation
    channels: tuple[str, ...]
    time_grid: tuple[float, ...]
    provenance: dict[str, Any]
    conditioning: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not {VELOCITY, CODEC} & set(self.networks):
            raise ConfigError(f"networks {sorted(self.networks)}", f"{VELOCITY!r} or {CODEC!r} among them")
        grid = self.time_grid
        if len(grid) < 2 or (grid[0], grid[-1]) != (1, 0) or any(a <= b for a, b in pairwise(grid)):
            raise ConfigError(f"time grid {grid}", "at least two times descending from 1 (noise) to 0 (data)")
        if missing := [k for k in ("data", "data_licence", "licence") if not self.provenance.get(k)]:
            raise ConfigError(f"a provenance without {', '.join(missing)}", "data, data_licence and licence")
        if unknown := sorted(set(self.conditioning) - set(CONDITIONS)):
            raise ConfigError(f"conditioning on {unknown}", f"some of {', '.join(CONDITIONS)}")
        shape = (self.tensors.size, *self.sensor.shape)
        # What stands next to the range image works on the sensor's own grid.
        arguments = self.networks[CODEC if CODEC in self.networks else VELOCITY].arguments
        given = (arguments.get("channels", shape[0]), *arguments.get("resolution", shape[1:]))
        if given != shape:
            raise ConfigError(
                f"a network for {given} channels, rows and columns",
                f"{shape}: channels {self.channels} on sensor {self.sensor.name!r}",
            )

    @property
    def tensors(self) -> TensorFormat:
        """Range images to the network's tensors and back."""
        return TensorFormat(self.channels, self.normalisation)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, as the file holds them; without ``weights`` and ``checksum``."""
        return {
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

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "Header":
        """The inverse of ``to_dict``.

        Raises:
            ConfigError: on another format, and on keys or values that do not belong into a header.
        """
        values = dict(values)
        if (given := values.pop("format", None)) not in (FORMAT, WITHOUT_CHECKSUM):
            raise ConfigError(f"format {given!r}", repr(FORMAT), "Use the version of lidar_synth that wrote it.")
        try:
            header = cls(
                networks={name: NetworkSpec(**part) for name, part in values["networks"].items()},
                sensor=Sensor.from_dict(values["sensor"]),
                normalisation=Normalisation(**values["normalisation"]),
                channels=tuple(values["channels"]),
                time_grid=tuple(map(float, values["time_grid"])),
                provenance=dict(values["provenance"]),
                conditioning=dict(values["conditioning"]),
            )
        except KeyError as error:
            raise ConfigError(f"a header without {error}", "all keys of the format") from error
        except (TypeError, AttributeError) as error:
            raise ConfigError(f"a header that does not fit together ({error})", "the values of the format") from error
        expected = header.to_dict()
        if unknown := sorted(set(values) - set(expected)):
            raise ConfigError(f"header keys {unknown}", f"those of {FORMAT}")
        for key in ("convention", "label_encoding"):
            if values.get(key) != expected[key]:
                raise ConfigError(f"{key} {values.get(key)!r}", repr(expected[key]))
        return header


def join(networks: Mapping[str, nn.Module]) -> nn.Module:
    """The flow of a checkpoint as one v(y, t, c) that takes conditions as they are stored."""
    velocity = networks[VELOCITY]
    return Conditioned(velocity, networks[ENCODER]) if ENCODER in networks else velocity


def split(network: nn.Module) -> dict[str, nn.Module]:
    """The inverse of ``join``."""
    if isinstance(network, Conditioned):
        return {VELOCITY: network.velocity, ENCODER: network.encoder}
    return {VELOCITY: network}


class Checkpoint(NamedTuple):
    """A checkpoint that was read.

    Args:
        header: what it says about its weights.
        networks: by part, in evaluation mode, float32.
        hash: sha256 in hexadecimal, of the header and, through it, of the weights.
    """

    header: Header
    networks: dict[str, nn.Module]
    hash: str


def save_checkpoint(
    path: Path, header: Header, networks: Mapping[str, nn.Module], dtype: torch.dtype | None = None
) -> str:
    """Write a checkpoint beside ``path``, then rename it; the same content gives the same bytes.

    Args:
        path: ends in ``.safetensors``.
        header: its ``networks`` have to describe those given.
        networks: by part.
        dtype: store the parameters in this precision; buffers stay as they are.

    Returns:
        The checkpoint's hash.

    Raises:
        ConfigError: on another suffix, or where header and networks differ.
        DataError: on weights that are not finite.
        FileError: where the file cannot be written.
    """
    path = Path(path)
    if path.suffix != ".safetensors":
        raise ConfigError(f"checkpoint {path}", "a name that ends in .safetensors")
    if set(networks) != set(header.networks):
        raise ConfigError(f"networks {sorted(networks)}", f"those of the header: {sorted(header.networks)}")
    tensors = {}
    for name, network in networks.items():
        state = {k: v.detach().cpu() for k, v in network.state_dict().items()}
        assemble(*header.networks[name], state, f"the network {name!r}")
        parameters = {k for k, _ in network.named_parameters()}
        for key, tensor in state.items():
            tensors[f"{name}.{key}"] = tensor.to(dtype if key in parameters else None).contiguous()
    _check_finite(tensors, "the network")
    values = {**header.to_dict(), "weights": weights_hash(tensors)}
    try:
        checksum = _checksum(values)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"a header with a value that JSON does not hold ({error})", "plain, finite values") from error
    text = json.dumps({**values, "checksum": checksum}, sort_keys=True)
    write_file(path, save(tensors, {"lidar_synth": text}), durable=True)
    return checksum


def load_checkpoint(path: Path, device: torch.device | str = "cpu") -> Checkpoint:
    """Read a checkpoint and build its networks.

    Args:
        path: a file of ``save_checkpoint``.
        device: where the networks shall be.

    Raises:
        ConfigError: on a device that is not there.
        FileError: where the file cannot be read.
        DataError: on a file that is no checkpoint of this version, is cut or damaged, or whose weights do not fit
            its header.
    """
    device = checked_device(device)
    _, header, digest, weights, tensors = _read(Path(path))
    if weights != weights_hash(tensors):
        raise DataError(f"{path}: the weights do not have the sum in the header", "a whole file", "Copy it again.")
    _check_finite(tensors, str(path))
    networks = {}
    for name, part in header.networks.items():
        # Copies are aligned; the file's own memory is not, and products differ in their last bits by that.
        state = {k.removeprefix(f"{name}."): v.clone() for k, v in tensors.items() if k.startswith(f"{name}.")}
        networks[name] = assemble(*part, state, f"{path}: the network {name!r}", device)
    if foreign := [k for k in tensors if k.partition(".")[0] not in header.networks]:
        raise DataError(f"{path}: tensors {foreign}", f"those of {sorted(header.networks)} only")
    return Checkpoint(header, networks, digest)


def read_header(path: Path) -> tuple[Header, str]:
    """The header of a checkpoint and its hash, without its weights; raises as ``load_checkpoint``."""
    content = _read(Path(path), tensors=False)
    return content.header, content.hash


def has_checksum(path: Path) -> bool:
    """Whether a damaged header of this checkpoint would be noticed; raises as ``load_checkpoint``."""
    return _read(Path(path), tensors=False).format == FORMAT


class _Content(NamedTuple):
    """What a file holds; ``weights`` is their sum as the header tells it."""

    format: str
    header: Header
    hash: str
    weights: Any
    tensors: dict[str, Tensor]


def _read(path: Path, tensors: bool = True) -> _Content:
    """The content of a checkpoint whose header is as it was written; its tensors are not checked yet."""
    try:
        with path.open("rb") as file:
            start = file.read(2)
    except OSError as error:
        raise FileError(f"checkpoint {path} cannot be read ({error.strerror})", "a .safetensors file") from error
    if start in (b"PK", b"\x80\x02"):
        raise DataError(
            f"{path} is a PyTorch pickle",
            "a .safetensors checkpoint",
            f"A pickle can run code and is never loaded as a checkpoint. Peers' released weights are converted by: "
            f"lidar-synth import {path} OUT.safetensors (--peer lidm for LiDM's)",
        )
    try:
        with safe_open(path, framework="pt") as content:
            text = (content.metadata() or {}).get("lidar_synth")
            held = {key: content.get_tensor(key) for key in content.keys()} if tensors else {}  # noqa: SIM118
    except SafetensorError as error:
        raise DataError(f"{path} is cut, damaged or no .safetensors file ({error})", "a whole file") from error
    if text is None:
        raise DataError(f"{path} has weights but no header of lidar_synth", f"a file of {FORMAT}")
    try:
        values = json.loads(text)
        version = values.get("format")
        digest = _hash(text) if version == WITHOUT_CHECKSUM else _verified(values)
        weights = values.pop("weights", None)
        return _Content(version, Header.from_dict(values), digest, weights, held)
    except (ValueError, AttributeError, RecursionError) as error:  # a ConfigError is a ValueError
        raise DataError(f"{path}: {error}") from error


def _verified(values: dict[str, Any]) -> str:
    """Take the checksum out of a header's values; raise where it is not theirs."""
    checksum = values.pop("checksum", None)
    if values.get("format") == FORMAT and checksum != _checksum(values):
        raise ConfigError("the header does not have its checksum", "a whole file", "Copy it again.")
    return str(checksum)


def _checksum(values: Mapping[str, Any]) -> str:
    """sha256 of plain values, whatever the order of their keys."""
    return _hash(json.dumps(values, sort_keys=True, allow_nan=False))


def _check_finite(tensors: Mapping[str, Tensor], what: str) -> None:
    """Refuse values that are no finite float32, which is what a network is built from."""
    if bad := [k for k, v in tensors.items() if v.is_complex() or not bool(torch.isfinite(v.float()).all())]:
        raise DataError(f"{what} has NaN or infinity in {bad}", "finite weights and ray angles")


def network_hash(network: nn.Module) -> str:
    """``weights_hash`` of a network's state, wherever it is."""
    return weights_hash({key: value.cpu() for key, value in network.state_dict().items()})


def weights_hash(tensors: Mapping[str, Tensor]) -> str:
    """sha256 of the names, types, shapes and bytes of tensors on the CPU, in hexadecimal."""
    digest = hashlib.sha256()
    for key in sorted(tensors):
        tensor = tensors[key]
        digest.update(f"{key} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
