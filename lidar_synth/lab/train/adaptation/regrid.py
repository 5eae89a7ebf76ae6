"""A model moved to the grid of another sensor, as the start of a training on its scans.

Nearly all weights are convolutions and attention, which have no place. What belongs to places is
interpolated: learned biases by row (of a beam's elevation, which on a road gives the range), and
the table of positions, whose columns wrap around. Ray angles are those of the new sensor. The moved
model generates no good scans until it has been trained.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from lidar_synth.errors import ConfigError
from lidar_synth.generate.checkpoint import (
    CODEC,
    ENCODER,
    VELOCITY,
    Checkpoint,
    Header,
    NetworkSpec,
)
from lidar_synth.generate.codec import make_codec
from lidar_synth.generate.models import build_network
from lidar_synth.geometry import Sensor
from lidar_synth.lab.train.start import limit_ranges

ANGLES = "angles.cells"
"""Ray angles of the cells of the state, which are replaced."""


class Axes(NamedTuple):
    """Which axes of a weight are the rows and the columns of a grid; None where it does not depend
    on them."""

    rows: int
    columns: int | None = None


PLACED: dict[str, dict[str, Axes]] = {
    "surfaces": {
        name: Axes(2) for name in ("place_stem", "place_latent", "place_outer")
    },
    "hdit": {"position.table": Axes(0, 1)},
    "denoiser": {"position.table": Axes(0, 1)},
    "semantic_map": {},
}
"""{architecture: its weights that belong to places}. A model of other architectures is not
moved."""
CONDITIONS = ("semantic",)
"""Conditions of the models that are moved."""


def fit_grid(sensor: Sensor, header: Header) -> Sensor:
    """The grid of a sensor on which a model can be trained: with as many columns as its networks
    can have, and within the model's range limits.

    Raises:
        ConfigError: on rows that the networks cannot have, or range limits without anything in
            common.
    """
    rows, columns = unit_of(header)
    if sensor.shape[0] % rows:
        raise ConfigError(
            f"sensor {sensor.name!r} with {sensor.shape[0]} rows",
            f"a multiple of {rows} rows",
        )
    wanted = columns * max(1, round(sensor.columns / columns))
    return replace(limit_ranges(sensor, header.normalisation), columns=wanted)


def unit_of(header: Header) -> tuple[int, int]:
    """Rows and columns of which a sensor needs a multiple, for the networks of a model."""
    velocity = header.networks[VELOCITY].arguments
    levels = len(velocity.get("depths", (3, 3, 3, 3)))
    patch = velocity.get("patch", (1, 4))
    state = velocity["resolution"]
    rows, columns = (
        header.sensor.shape[i] // state[i] * patch[i] << (levels - 1) for i in (0, 1)
    )
    return rows, columns


def regrid(model: Checkpoint, sensor: Sensor) -> tuple[Header, dict[str, nn.Module]]:
    """The networks of a model on the grid of another sensor, and the header that describes them.

    Args:
        model: an unconditional model, or one with a condition among ``CONDITIONS``.
        sensor: as ``fit_grid`` gives it.

    Raises:
        ConfigError: on an autoencoder alone, a model with another condition, or one of an
            architecture that is not in ``PLACED``.
    """
    header = model.header
    check_movable(header)
    networks: dict[str, nn.Module] = {}
    parts: dict[str, NetworkSpec] = {}
    state = sensor.shape
    # the autoencoder first: it gives the shape of the states
    for name in sorted(model.networks):
        part = header.networks[name]
        sizes = {"resolution": list(state if name == VELOCITY else sensor.shape)}
        if name == ENCODER:
            sizes["target"] = list(state)
        parts[name] = NetworkSpec(part.architecture, part.arguments | sizes)
        networks[name] = _moved(
            model.networks[name], parts[name], header.sensor, sensor
        )
        if name == CODEC:
            state = make_codec(networks[CODEC], header.tensors, sensor.shape).shape[1:]
    return replace(header, networks=parts, sensor=sensor, matches={}), networks


def check_movable(header: Header) -> None:
    """Refuse a model that ``regrid`` cannot move; raises as it does."""
    if VELOCITY not in header.networks:
        raise ConfigError("an autoencoder", "a model that generates")
    if not set(header.conditioning) <= set(CONDITIONS):
        wanted = f"an unconditional model, or the condition {', '.join(CONDITIONS)}"
        raise ConfigError(
            f"a model with the condition {', '.join(header.conditioning)}", wanted
        )
    if unknown := [
        part.architecture
        for part in header.networks.values()
        if part.architecture not in PLACED
    ]:
        raise ConfigError(
            f"a model with the architecture {', '.join(unknown)}",
            f"architectures among {', '.join(PLACED)}: those that can be moved to another sensor",
            "The shipped models 'town' and 'town-semantic' can.",
        )


def _moved(
    network: nn.Module, part: NetworkSpec, old: Sensor, new: Sensor
) -> nn.Module:
    """A network with a new resolution and interpolated weights."""
    made = build_network(*part)
    state = network.state_dict()
    for name, axes in PLACED[part.architecture].items():
        state[name] = _interpolated(
            state[name], axes, made.state_dict()[name].shape, old, new
        )
    if ANGLES in state:
        shape = made.state_dict()[ANGLES].shape[1:]
        angles = torch.from_numpy(new.ray_angles())
        state[ANGLES] = F.avg_pool2d(
            angles[None], (new.shape[0] // shape[0], new.shape[1] // shape[1])
        )[0]
    made.load_state_dict(state)
    return made.eval()


def _interpolated(
    weight: Tensor, axes: Axes, shape: torch.Size, old: Sensor, new: Sensor
) -> Tensor:
    before = _elevations(old, weight.shape[axes.rows])
    after = _elevations(new, shape[axes.rows])
    weight = _along(
        weight,
        axes.rows,
        np.interp(after, before[::-1], np.arange(len(before))[::-1]),
        wraps=False,
    )
    if axes.columns is not None:
        count = weight.shape[axes.columns]
        wanted = shape[axes.columns]
        weight = _along(
            weight,
            axes.columns,
            (np.arange(wanted) + 0.5) * count / wanted - 0.5,
            wraps=True,
        )
    return weight


def _elevations(sensor: Sensor, groups: int) -> NDArray[np.float64]:
    """(groups,) mean elevation of equal groups of rows, highest first."""
    means: NDArray[np.float64] = (
        sensor.row_elevations().astype(np.float64).reshape(groups, -1).mean(1)
    )
    return means


def _along(
    weight: Tensor, axis: int, places: NDArray[np.float64], wraps: bool
) -> Tensor:
    """A weight at fractional ``places`` of an axis, interpolated linearly."""
    count = weight.shape[axis]
    low = np.floor(places)
    share = torch.from_numpy(places - low).to(weight.dtype)
    first, second = (
        i.astype(np.int64) % count if wraps else i.astype(np.int64).clip(0, count - 1)
        for i in (low, low + 1)
    )
    share = share.view(*(-1 if i == axis else 1 for i in range(weight.ndim)))
    one, other = (
        weight.index_select(axis, torch.from_numpy(i)) for i in (first, second)
    )
    return torch.lerp(one, other, share)
