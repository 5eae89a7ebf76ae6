"""Sources of synthetic scans: one interface for generators, banks and scans that exist already."""

from dataclasses import replace
from typing import Any, Protocol, cast, runtime_checkable

from lidar_synth.geometry import SYNTHETIC, Scan, Sensor, Source, identity_of
from lidar_synth.mixing.sources import first_of


@runtime_checkable
class Synthetic(Protocol):
    """A source of synthetic scans by number.

    A source that works ahead may also have the methods ``set_epoch(epoch)`` and
    ``expect(numbers)``; ``MixedScans`` calls them. ``numbers`` are the scans that this process and
    its workers will request next, in order.

    Attributes:
        sensor: the sensor of the scans.
        fields: the fields of ``POINT_FIELDS`` that the scans have, and "boxes" if they have boxes.
        length: number of scans, numbered 0 .. length - 1; None = endless.
        identity: text of everything that determines the scans, such as checkpoint and seed; part of
            the plan's hash.
    """

    @property
    def sensor(self) -> Sensor: ...

    @property
    def fields(self) -> frozenset[str]: ...

    @property
    def length(self) -> int | None: ...

    @property
    def identity(self) -> str: ...

    def __getitem__(self, number: int, /) -> Scan:
        """The scan, with domain ``SYNTHETIC``; a function of the number alone."""
        ...


class Held:
    """Existing scans (a folder that ``lidar-synth sample`` wrote, a town) as a synthetic source.

    Args:
        source: the scans; the fields of the first scan count as those of all.
    """

    def __init__(self, source: Source) -> None:
        first = first_of(source)
        self.sensor: Sensor = getattr(source, "sensor", first.sensor)
        self.fields = frozenset(first.fields()) | (
            frozenset() if first.boxes is None else {"boxes"}
        )
        self.length: int | None = len(source)
        self.identity = identity_of(source)
        self._source = source

    def __getitem__(self, number: int) -> Scan:
        return replace(self._source[number], domain=SYNTHETIC)


def make_synthetic(source: Any, seed: int = 0) -> Synthetic:
    """Make a synthetic source from a user's argument: a generator, a bank or another ``Synthetic``,
    or existing scans.

    Args:
        source: one of these.
        seed: seed of the scans that a generator makes.

    Raises:
        ConfigError: on any other type, or samples that are not scans.
        DataError: on existing scans of which there are none.
    """
    if hasattr(source, "as_synthetic"):
        return cast(Synthetic, source.as_synthetic(seed))
    if isinstance(source, Synthetic) and not getattr(source, "recorded", False):
        return source
    return Held(source)
