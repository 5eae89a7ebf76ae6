"""Features of scans: the extractors of a protocol, and the figures that two sets of features
give."""

import importlib
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import DataError, choose
from lidar_synth.geometry import Scan
from lidar_synth.lab.evaluate.cache import Cached, weights_hash
from lidar_synth.lab.evaluate.distances import frechet_distance, squared_mmd
from lidar_synth.lab.evaluate.intervals import extrapolated_frechet
from lidar_synth.lab.evaluate.labels import class_shares
from lidar_synth.lab.evaluate.neighbours import manifold
from lidar_synth.lab.evaluate.protocols import FEATURES, Measure, Protocol
from lidar_synth.lab.evaluate.statistics import Statistic, frechet, polynomial_mmd

Extractor = Callable[[Sequence[Scan]], NDArray[np.floating]]
"""Features of a few scans: n scans -> (n, D)."""

Paired = Callable[[Sequence[Scan], bool], NDArray[np.floating]]
"""As ``Extractor``, with whether the scans are generated: some protocols prepare the two sets
differently."""

SAMPLES_PER_FEATURE = 4
"""Samples for each feature from which a Fréchet distance gets an interval; with fewer it does not
cover the truth."""

JOINED: dict[str, Callable[[Scan], NDArray[np.float64]]] = {
    "class_shares": class_shares
}
"""Descriptions that a measure joins to features, by the name of its option ``join``."""


class Loaded(NamedTuple):
    """The extractors of a protocol.

    Args:
        extractors: {name of the measure: extractor}, of those whose weights are there.
        missing: {name of the measure: why it cannot be measured}.
    """

    extractors: dict[str, Paired]
    missing: dict[str, str]


def load_extractors(
    protocol: Protocol, weights: Path | None = None, cache: Path | None = None
) -> Loaded:
    """Load the extractors of a protocol whose weights are in a folder.

    Args:
        protocol: whose measures of features name them.
        weights: folder with the published archives; by default the one that LIDAR_SYNTH_METRICS
            names.
        cache: folder for features; None = they are not kept.

    Raises:
        ConfigError, DataError, FileError: on weights that are there but cannot be used.
    """
    loaded = Loaded({}, {})
    for name, measure in protocol.measures.items():
        if measure.kind != FEATURES:
            continue
        path = find_weights(str(measure.extractor), weights)
        if path is None:
            loaded.missing[name] = (
                f"no weights of {measure.extractor}; lidar-synth metrics setup says where to get "
                "them"
            )
        else:
            loaded.extractors[name] = load_published(measure, path, cache)
    return loaded


def load_published(measure: Measure, path: Path, cache: Path | None = None) -> Paired:
    """The extractor of a measure, with what its option ``join`` names appended to the features;
    ``cache`` as in ``load_extractors``."""
    extract = _package().load_extractor(measure.extractor, path, measure.preparation)
    join = JOINED[measure.options["join"]] if "join" in measure.options else None

    def features(scans: Sequence[Scan], generated: bool) -> NDArray[np.floating]:
        own: NDArray[np.floating] = extract(scans, generated=generated)
        if join is None:
            return own
        return np.concatenate([own, np.stack([join(scan) for scan in scans])], axis=1)

    if cache is None:
        return features
    key = (
        f"{measure.extractor} {measure.preparation} {sorted(measure.options.items())} "
        f"{weights_hash(path)}"
    )
    return Cached(features, cache, key)


def find_weights(extractor: str, folder: Path | None) -> Path | None:
    """Where the weights of an extractor are; None if they are not there.

    Raises:
        ConfigError: on an unknown extractor.
    """
    package = _package()
    if package is None:
        return None
    found: Path | None = choose("extractor", extractor, package.EXTRACTORS).found(
        folder
    )
    return found


def _package() -> Any:
    """The extractors' package, which is imported only where one is asked for."""
    try:
        return importlib.import_module("lidar_synth.lab.evaluate.extractors")
    except ModuleNotFoundError:
        return None


def statistic_of(
    real: NDArray[np.floating], fake: NDArray[np.floating]
) -> Statistic | None:
    """The Fréchet distance to resample; None with too few samples for an interval."""
    enough = min(len(real), len(fake)) >= SAMPLES_PER_FEATURE * real.shape[1]
    return frechet(real, fake) if enough else None


Figure = tuple[
    str, Callable[[], float], Callable[[], Statistic | None], tuple[float, float]
]
"""Title, value, statistic to resample (None = no interval), and the smallest and the largest
possible value."""

ANY = (-np.inf, np.inf)
POSITIVE = (0.0, np.inf)
SHARE = (0.0, 1.0)


def figures_of(
    name: str, real: NDArray[np.floating], fake: NDArray[np.floating], extended: bool
) -> list[Figure]:
    """The figures of an extractor's features without a protocol.

    Args:
        name: of the extractor.
        real, fake: (N, D) and (M, D) features.
        extended: add unbiased forms, precision, recall, density and coverage.
    """
    figures: list[Figure] = [
        (
            f"Frechet distance of {name}",
            partial(frechet_distance, real, fake),
            partial(statistic_of, real, fake),
            POSITIVE,
        ),
        (
            f"squared maximum mean discrepancy of {name}",
            partial(squared_mmd, real, fake),
            partial(polynomial_mmd, real, fake),
            ANY,
        ),
    ]
    return figures + more_figures(name, real, fake) if extended else figures


def figures_beside(
    name: str, real: NDArray[np.floating], fake: NDArray[np.floating]
) -> list[Figure]:
    """The figures beside those of a protocol: the unbiased discrepancy, and ``more_figures``."""
    statistic = polynomial_mmd(real, fake)
    title = f"unbiased squared maximum mean discrepancy of {name}"
    unbiased: Figure = (title, lambda: statistic.value, lambda: statistic, ANY)
    return [unbiased, *more_figures(name, real, fake)]


def more_figures(
    name: str, real: NDArray[np.floating], fake: NDArray[np.floating]
) -> list[Figure]:
    """The extrapolated Frechet distance, precision, recall, density and coverage; those for which
    there are enough samples."""
    figures: list[Figure] = []

    def add(title: str, statistic: Statistic, limits: tuple[float, float]) -> None:
        figures.append(
            (f"{title} of {name}", lambda: statistic.value, lambda: statistic, limits)
        )

    try:
        value = extrapolated_frechet(real, fake)
        figures.append(
            (
                f"Frechet distance of {name}, infinitely many samples",
                lambda: value,
                lambda: None,
                ANY,
            )
        )
    except DataError:
        pass  # too few samples to extrapolate from
    try:
        for title, statistic in manifold(real, fake)._asdict().items():
            add(title, statistic, POSITIVE if title == "density" else SHARE)
    except DataError:
        pass  # too few samples for neighbours
    return figures


def describe_missing(missing: Mapping[str, str], protocol: Protocol) -> str:
    """One line per measure that could not be measured, with the reason."""
    measures = protocol.measures
    return "\n".join(
        f"{measures[n].table or measures[n].title}: {reason}"
        for n, reason in missing.items()
    )
