"""Protocols as data: how a paper prepares scans, how many it compares, and what its tables call
each figure.

Each YAML file in this folder is one protocol; ``Protocol`` says what it contains. To add a
protocol, write a file.
"""

from collections.abc import Mapping
from functools import cache, cached_property
from importlib.resources import files
from typing import Any, Literal, NamedTuple

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from lidar_synth.errors import ConfigError, choose
from lidar_synth.geometry import Scan, Sensor, presets
from lidar_synth.geometry.projection import locate, project, unproject
from lidar_synth.lab.evaluate.measures import KINDS

FEATURES = "frechet"
"""The kind of a figure that is a Fréchet distance of an extractor's features."""

VIEW = 2.0
"""Degrees by which the edges of the field of view of two sensors may differ that count as alike."""

Placement = Literal["points", "corner", "centre"]


class _Data(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Preparation(_Data):
    """What a protocol does to every scan before it measures.

    Args:
        sensor: preset of the grid; None = the scan's own.
        real, generated: where the points of each set lie: ``points`` keeps those that cells show,
            ``corner`` and ``centre`` put them on the rays through the cells' corners or centres.
        before: ranges kept before the projection, both exclusive, metres.
        after: ranges kept after it, both exclusive, metres.
    """

    sensor: str | None = None
    real: Placement = "centre"
    generated: Placement = "centre"
    before: tuple[float, float] | None = None
    after: tuple[float, float] | None = None

    @cached_property
    def grid(self) -> Sensor | None:
        """The grid onto which scans are projected; None = each scan's own."""
        if self.sensor is None:
            return None
        sensor = presets()[self.sensor]
        if self.before is None:
            return sensor
        low = np.float32(self.before[0])
        high = np.float32(self.before[1])
        near = np.nextafter(low, high)
        far = np.nextafter(high, low)
        return Sensor(
            f"{self.sensor} from {self.before[0]:g} m to {self.before[1]:g} m",
            sensor.columns,
            float(near),
            float(far),
            rows=sensor.rows,
            fov_up=sensor.fov_up,
            fov_down=sensor.fov_down,
        )

    def apply(self, scan: Scan, generated: bool) -> Scan:
        """The points that the protocol compares, with their labels."""
        sensor = self.grid or scan.sensor
        placement = self.generated if generated else self.real
        if placement == "points":
            shown = locate(scan.points, sensor).point
            prepared = scan[shown[shown >= 0]]
        else:
            image = project(scan, sensor, ["label"] if scan.label is not None else [])
            prepared = unproject(image, placement)
            prepared.id = scan.id
        if self.after is not None:
            distance = np.linalg.norm(prepared.points, axis=1)
            prepared = prepared[(distance > self.after[0]) & (distance < self.after[1])]
        return prepared


class Measure(_Data):
    """One figure of a protocol.

    Args:
        kind: a name of ``KINDS``, or ``frechet`` for features.
        title: what it is.
        table: what the paper's tables call it; "" where no paper reports it.
        times: the factor by which the tables show it.
        options: of the kind.
        extractor, preparation: for ``frechet``: a name of ``EXTRACTORS``, and how scans become its
            input.
        real: number of real scans, chosen at random with seed 0; None = all.
        generated: number of generated scans, the first ones; None = all.
        least: the smallest possible value, if there is one.
    """

    kind: str
    title: str
    table: str = ""
    times: float = 1.0
    options: dict[str, Any] = Field(default_factory=dict)
    extractor: str | None = None
    preparation: str | None = None
    real: int | None = None
    generated: int | None = None
    least: float | None = 0.0

    def model_post_init(self, _: Any) -> None:
        if self.kind not in KINDS and self.kind != FEATURES:
            raise ValueError(
                f"kind {self.kind!r} is none of {', '.join([*KINDS, FEATURES])}"
            )
        if (self.kind == FEATURES) != (self.extractor is not None):
            raise ValueError(
                f"{self.title}: {FEATURES} and no other kind has an extractor"
            )


class Reference(_Data):
    """The scans that a paper compares with.

    Args:
        layout: of the dataset, a name of ``READERS``.
        split: that the paper's figures are for, as ``--split`` names it.
        others: further splits that its code offers.
        training: the split on which the paper trains its generator.
    """

    layout: str
    split: str
    others: tuple[str, ...] = ()
    training: str | None = None


class NeededScans(NamedTuple):
    """Numbers of scans that a paper compares; None = any."""

    real: int | None = None
    generated: int | None = None


class Protocol(_Data):
    """A definition of how two sets of scans are compared.

    Args:
        name: of the protocol.
        source: the public code or text that was read, with its version.
        unverified: what could not be read there, in sentences; empty = nothing.
        needs: smallest numbers of scans for figures that can stand beside the paper's.
        reference: what the paper compares with; None where it is no paper's protocol.
        prepare: what is done to every scan.
        measures: {name: measure}.
    """

    name: str
    source: str = ""
    unverified: str = ""
    needs: NeededScans = NeededScans()
    reference: Reference | None = None
    prepare: Preparation = Preparation()
    measures: dict[str, Measure]

    def cloud(self, scan: Scan, generated: bool) -> NDArray[np.float32]:
        """(N, 3) the points of a scan that the protocol compares, metres; ``generated`` is whether
        it is a generated one."""
        return self.prepare.apply(scan, generated).points

    @property
    def limit(self) -> int | None:
        """Most real scans that any figure without features takes; None = all."""
        taken = [m.real for m in self.measures.values() if m.kind != FEATURES]
        if None in taken:
            return None
        return max((t for t in taken if t is not None), default=None)


def alike(a: Sensor, b: Sensor) -> bool:
    """Whether two sensors have as many rows and about the same field of view."""
    return (
        a.shape[0] == b.shape[0]
        and abs(a.up - b.up) <= VIEW
        and abs(a.down - b.down) <= VIEW
    )


def parse_protocol(text: str, where: str) -> Protocol:
    """The protocol that a YAML text describes.

    Raises:
        ConfigError: on unknown keys, or values that no protocol can have.
    """
    try:
        return Protocol(**yaml.safe_load(text))
    except (ValidationError, TypeError, yaml.YAMLError) as error:
        raise ConfigError(
            f"{where}: {error}",
            "a protocol as lidar_synth/lab/evaluate/protocols/ has them",
        ) from error


@cache
def _shipped() -> Mapping[str, Protocol]:
    folder = files("lidar_synth.lab.evaluate.protocols")
    names = sorted(
        entry.name for entry in folder.iterdir() if entry.name.endswith(".yaml")
    )
    read = (
        parse_protocol(folder.joinpath(name).read_text(encoding="utf-8"), name)
        for name in names
    )
    return {protocol.name: protocol for protocol in read}


PROTOCOLS: dict[str, Protocol] = dict(_shipped())
"""Protocols by name."""


def find_protocol(protocol: str | Protocol) -> Protocol:
    """The protocol of a name, or the protocol itself.

    Raises:
        ConfigError: on an unknown name.
    """
    if isinstance(protocol, Protocol):
        return protocol
    return choose("protocol", protocol, PROTOCOLS)
