"""``Sources``: several sources as one; and the check that sources can be mixed."""

from collections.abc import Callable, Sequence
from itertools import product
from typing import Any

import numpy as np
from torch.utils.data import ConcatDataset

from lidar_synth.datasets.classes import NAMES
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.geometry import Scan, Sensor, check_source, index_of
from lidar_synth.labels.own import check_share


class Sources:
    """Several real or several synthetic sources that ``MixedScans`` takes as one.

    Args:
        sources: in order.
        weights: one for each source; its number of samples in an epoch is proportional to its
            weight. By default the weight of a real source is its length, and synthetic sources have
            equal weights.
        loss_weights: for each source the factor, from 0 to 1, by which to multiply the loss of its
            samples; by default 1.

    Raises:
        ConfigError: without a source, on another number of weights, or on loss weights that are
            not from 0 to 1.

    Example:
        >>> from lidar_synth import Bank, MixedScans, Sources, load_generator
        >>> synth = Sources(Bank("demo_out/bank"), load_generator("town"), weights=[3, 1])
        >>> train = MixedScans(None, synth, ratio=1.0, epoch_size=4)
        >>> sorted(train[i]["id"] for i in range(4))  # seed 0: the generator, 1: the bank
        ['town/0/0', 'town/1/0', 'town/1/1', 'town/1/2']
    """

    def __init__(
        self,
        *sources: Any,
        weights: Sequence[float] | None = None,
        loss_weights: Sequence[float] | None = None,
    ) -> None:
        for name, given in (("weights", weights), ("loss_weights", loss_weights)):
            if not sources or (given is not None and len(given) != len(sources)):
                raise ConfigError(
                    f"{len(sources)} sources with {name} {given}",
                    "sources, and a weight for each or none",
                )
        self.loss_weights = tuple(
            check_share("loss weight", weight)
            for weight in (
                [1.0] * len(sources) if loss_weights is None else loss_weights
            )
        )
        self.sources = sources
        self.weights: tuple[float | None, ...] = tuple(
            w.item() if isinstance(w, np.generic) else w
            for w in ([None] * len(sources) if weights is None else weights)
        )

    def __len__(self) -> int:
        return sum(map(len, self.sources))

    def __getitem__(self, index: int) -> Any:
        """The scan at ``index`` of the concatenated sources."""
        return ConcatDataset(self.sources)[index_of(index, len(self))]


def each(source: Any) -> tuple[tuple[Any, float | None], ...]:
    """The (source, weight) pairs of an argument: a source, ``Sources``, or None for no source."""
    if source is None:
        return ()
    if isinstance(source, Sources):
        return tuple(zip(source.sources, source.weights, strict=True))
    return ((source, None),)


def loss_weights_of(source: Any) -> tuple[float, ...]:
    """The loss weight of each source of an argument, as ``each``."""
    return getattr(source, "loss_weights", (1.0,) * len(each(source)))


def first_of(source: Any) -> Scan:
    """The first scan of a source.

    Raises:
        ConfigError: if it has no samples by number, or they are not scans.
        DataError: if it is empty.
    """
    check_source(source)
    if not len(source):
        raise DataError("a source without scans", "at least one scan")
    first = source[0]
    if not isinstance(first, Scan):
        raise ConfigError(
            f"samples of the type {type(first).__name__}",
            "scans",
            "Sources(a, b) joins several sources; MixedScans.wrap(dataset, synth, to_sample=...) "
            "takes a trainer's own dataset.",
        )
    return first


def sensor_of(source: Any) -> Sensor:
    """The sensor of a source of scans: its attribute ``sensor``, or else that of its first scan,
    see ``first_of``. A sensor is returned as it is."""
    sensor = getattr(source, "sensor", source)
    return sensor if isinstance(sensor, Sensor) else first_of(source).sensor


def agree(rule: Callable[[Sensor, Sensor], bool], reals: Any, synthetics: Any) -> bool:
    """Whether a rule holds for the sensors of each real and each synthetic source."""
    pairs = product(each(reals), each(synthetics))
    return all(
        rule(sensor_of(real), sensor_of(synth)) for (real, _), (synth, _) in pairs
    )


def check_together(
    sources: Sequence[Any], as_sensors: Sequence[Sensor | None]
) -> list[Sensor]:
    """Check that scans of several sources fit into one training set, and return the sensors of the
    samples.

    Sensors agree if their rows and columns have the same directions; range limits and names may
    differ. A source's attribute ``classes`` (names by train id) defines its labels; by default they
    are SemanticKITTI's 19 classes.

    Args:
        sources: the sources.
        as_sensors: for each source, the sensor that its scans are turned into; None for its own.

    Raises:
        ConfigError: on different grids or classes.
    """
    sensors = [
        wanted or sensor_of(source)
        for source, wanted in zip(sources, as_sensors, strict=True)
    ]
    for sensor in sensors[1:]:
        if not sensor.same_grid(sensors[0]):
            raise ConfigError(
                f"sources of the sensors {sensors[0].grid_text()} and {sensor.grid_text()}",
                "one grid for all real and synthetic scans",
                "Turn the synthetic scans into scans of the real ones' sensor "
                "(as_sensor=real.sensor), or open the "
                "real scans with the generator's sensor (sensor=generator.sensor).",
            )
    for source in sources:
        classes = tuple(getattr(source, "classes", NAMES))
        if classes != NAMES:
            raise ConfigError(
                f"a source whose labels mean {classes[:4]}... ({type(source).__name__})",
                f"SemanticKITTI's {len(NAMES)} train ids, {NAMES[:4]}...",
                "Map its labels when they are read (Taxonomy.decode), then remove its attribute "
                "'classes'.",
            )
    return sensors
