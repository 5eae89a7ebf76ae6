"""Sources of synthetic scans: one interface for generators, banks and scans that exist already."""

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol, runtime_checkable

from lidar_synth.errors import ConfigError
from lidar_synth.generate.generator import Generator
from lidar_synth.geometry.scan import SYNTHETIC, Scan, Source
from lidar_synth.geometry.sensor import Sensor
from lidar_synth.mixing.sources import identity_of


@runtime_checkable
class Synthetic(Protocol):
    """A source of synthetic scans by number.

    A source that works ahead may also have the methods ``set_epoch(epoch)`` and ``expect(numbers)``; ``MixedScans``
    calls them. ``numbers`` are the scans that this process and its workers will request next, in order.

    Attributes:
        sensor: the sensor of the scans.
        fields: the fields of ``POINT_FIELDS`` that the scans have, and "boxes" if they have boxes.
        length: number of scans, numbered 0 .. length - 1; None = endless.
        identity: text of everything that determines the scans, such as checkpoint and seed; part of the plan's hash.
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


class Generated:
    """Scans that a generator makes on access, in the process that accesses them.

    Args:
        generator: the model. On the CPU it also works in DataLoader workers. On a GPU it works in the main process
            only; in a worker it raises an error that names the three ways to use a GPU's scans.
        seed: of the scans; the number of a scan is its index.
        condition: for a conditional model, an indexable source of conditions, such as the real scans. Scan n is
            conditioned on entry n modulo the source's length; ``Generator.range_images`` lists the kinds of entries.
        cache: number of latest scans that each process keeps in memory (about 1 MB each at 64 x 1024), which saves
            time if a process accesses a scan again: with ``reuse``, an epoch later.
        sampling: steps, solver and guidance, as for ``Generator.scans``.

    Raises:
        ConfigError: on a negative cache, a conditional model without conditions, or conditions for an unconditional
            model.

    Example:
        >>> from lidar_synth import load_generator, open_scans
        >>> from lidar_synth.mixing import Generated
        >>> real = open_scans("demo_out/town")
        >>> synth = Generated(load_generator("town-semantic"), condition=real)  # for MixedScans(real, synth, ...)
        >>> sorted(synth[0].fields())
        ['confidence', 'label', 'reflectance']
    """

    length: None = None

    def __init__(
        self, generator: Generator, seed: int = 0, *, condition: Any = None, cache: int = 0, **sampling: Any
    ) -> None:
        if cache < 0:
            raise ConfigError(f"cache={cache}", "a number of scans")
        if (condition is None) != (generator.condition is None):
            raise ConfigError(
                f"{'no conditions' if condition is None else 'conditions'} for {generator.name!r}",
                f"a source of conditions ({generator.condition})" if generator.condition else "none",
                "Generated(generator, condition=real) conditions it on the scans of a source.",
            )
        self.generator, self.seed, self.condition = generator, seed, condition
        self._sampling, self._cache_size = sampling, cache
        self._cached: OrderedDict[int, Scan] = OrderedDict()

    @property
    def sensor(self) -> Sensor:
        """The sensor of the generator."""
        return self.generator.sensor

    @property
    def fields(self) -> frozenset[str]:
        """The fields that the scans have besides their points."""
        return self.generator.fields | {"reflectance"}

    @property
    def identity(self) -> str:
        """The checkpoint, the seed, the sampling options and the conditions as one text."""
        model = self.generator.hash or self.generator.name
        options = {k: v for k, v in sorted(self._sampling.items()) if v is not None}
        conditions = "" if self.condition is None else identity_of(self.condition)
        return f"generated:{model}:{self.seed}:{options}:{conditions}{self.generator.variant}"

    def __getitem__(self, number: int) -> Scan:
        if number in self._cached:
            self._cached.move_to_end(number)
            return self._cached[number]
        [scan] = self.scans([number])
        if self._cache_size:
            self._cached[number] = scan
            if len(self._cached) > self._cache_size:
                self._cached.popitem(last=False)
        return scan

    def scans(self, numbers: Sequence[int]) -> list[Scan]:
        """Several scans at once, which is faster on a GPU."""
        condition = None if self.condition is None else [self.condition[n % len(self.condition)] for n in numbers]
        return self.generator.scans(self.seed, numbers, condition, **self._sampling)

    def __repr__(self) -> str:
        fields = ", ".join(sorted(self.fields))
        made_by = f"Generated by {self.generator.name!r}, seed {self.seed}"
        return f"{made_by}\n  sensor {self.sensor.grid_text()}; {fields}"

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_cached": OrderedDict()}


class Held:
    """Existing scans (a folder that ``lidar-synth sample`` wrote, a town) as a synthetic source.

    Args:
        source: the scans; the fields of the first scan count as those of all.
    """

    def __init__(self, source: Source) -> None:
        first = source[0]
        self.sensor: Sensor = getattr(source, "sensor", first.sensor)
        self.fields = frozenset(first.fields()) | (frozenset() if first.boxes is None else {"boxes"})
        self.length: int | None = len(source)
        self.identity = identity_of(source)
        self._source = source

    def __getitem__(self, number: int) -> Scan:
        return replace(self._source[number], domain=SYNTHETIC)


def make_synthetic(source: Any, seed: int = 0) -> Synthetic:
    """Make a synthetic source from a user's argument: a generator, a bank or another ``Synthetic``, or existing scans.

    Args:
        source: one of these.
        seed: seed of the scans that a generator makes.

    Raises:
        ConfigError: on any other type.
    """
    if isinstance(source, Generator):
        return Generated(source, seed)
    if isinstance(source, Synthetic):
        return source
    by_index = isinstance(source, Source) and not isinstance(source, Mapping)
    if by_index and len(source) and isinstance(source[0], Scan):
        return Held(source)
    raise ConfigError(
        f"{type(source).__name__} as a source of synthetic scans",
        "a generator, a bank, a rolling bank, or scans by index",
        "load_generator('town') makes a generator of the shipped model.",
    )
