"""Two sets of scans compared by a named protocol, and by the features of any extractor."""

import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.evaluate import lidm, r2flow
from lidar_synth.evaluate.distances import frechet_distance, squared_mmd
from lidar_synth.geometry.projection import project, unproject
from lidar_synth.geometry.scan import Scan, Source

Extractor = Callable[[Sequence[Scan]], NDArray[np.floating]]
"""Features of a few scans: n scans -> (n, D)."""


@dataclass(frozen=True)
class Score:
    """One value of a metric with its protocol.

    Args:
        metric: name of the metric.
        value: the value; lower is better.
        protocol: name of the protocol that defines the metric.
        real: number of real scans.
        generated: number of generated scans.
    """

    metric: str
    value: float
    protocol: str
    real: int
    generated: int

    def __str__(self) -> str:
        setting = f"{self.protocol} protocol, {self.real} real, {self.generated} generated"
        return f"{self.metric} = {self.value:.6g} ({setting})"


class Protocol(NamedTuple):
    """A definition of how two sets of scans are compared.

    Args:
        cloud: ``(scan, generated) -> (N, 3)`` points to compare; ``generated`` is whether the scan is a generated one.
        describe: ``points -> description`` of a cloud.
        compare: ``(real descriptions, generated descriptions) -> {metric: value}``.
        limit: maximum number of real scans; of more, a fixed random subset is used.
    """

    cloud: Callable[[Scan, bool], NDArray[np.float32]]
    describe: Callable[[NDArray[np.float32]], Any]
    compare: Callable[[Sequence[Any], Sequence[Any]], dict[str, float]]
    limit: int | None = None


def _own_cloud(scan: Scan, generated: bool) -> NDArray[np.float32]:
    return unproject(project(scan, channels=())).points


PROTOCOLS = {
    "r2flow": Protocol(r2flow.cloud, r2flow.bev_histogram, r2flow.compare, limit=10_000),
    "lidm": Protocol(lidm.cloud, lidm.occupancy, lidm.compare),
    # R2Flow's metrics for scans of any sensor, with both sets projected to the centres of its own cells.
    "town": Protocol(_own_cloud, r2flow.bev_histogram, r2flow.compare),
}
"""Protocols by name."""


def evaluate(
    real: Source,
    generated: Source,
    protocol: str,
    extractors: Mapping[str, Extractor] | None = None,
    batch: int = 16,
    progress: bool = True,
) -> list[Score]:
    """Compare two sets of scans.

    Args:
        real: real scans.
        generated: generated scans.
        protocol: a name of ``PROTOCOLS``.
        extractors: feature extractors by name; each adds a Frechet distance and a squared maximum mean discrepancy.
        batch: number of scans that extractors process at a time.
        progress: whether to show a progress bar.

    Raises:
        ConfigError: on an unknown protocol.
        DataError: on an empty set, or a scan without returns in the protocol's area.
    """
    if protocol not in PROTOCOLS:
        raise ConfigError(f"protocol {protocol!r}", f"one of {', '.join(PROTOCOLS)}")
    rules, extractors = PROTOCOLS[protocol], extractors or {}
    chosen = list(range(len(real)))
    if rules.limit is not None and len(chosen) > rules.limit:
        random.Random(0).shuffle(chosen)
        chosen = chosen[: rules.limit]
    kept: list[list[Any]] = []
    features: list[dict[str, NDArray[np.floating]]] = []
    for name, source, indices in (("real", real, chosen), ("generated", generated, range(len(generated)))):
        if len(indices) == 0:
            raise DataError(f"no {name} scans", "at least one")
        described: list[Any] = []
        extracted: dict[str, list[NDArray[np.floating]]] = {e: [] for e in extractors}
        for first in tqdm(range(0, len(indices), batch), desc=f"{name} scans", disable=not progress):
            scans = [source[i] for i in indices[first : first + batch]]
            described += [_describe(rules, scan, name == "generated") for scan in scans]
            for e, extract in extractors.items():
                extracted[e].append(extract(scans))
        kept.append(described)
        features.append({e: np.concatenate(parts) for e, parts in extracted.items()})
    figures = rules.compare(*kept)
    for e in extractors:
        figures[f"Frechet distance of {e}"] = frechet_distance(features[0][e], features[1][e])
        figures[f"squared maximum mean discrepancy of {e}"] = squared_mmd(features[0][e], features[1][e])
    return [Score(metric, value, protocol, len(kept[0]), len(kept[1])) for metric, value in figures.items()]


def _describe(rules: Protocol, scan: Scan, generated: bool) -> Any:
    try:
        return rules.describe(rules.cloud(scan, generated))
    except DataError as error:
        raise DataError(f"{'generated' if generated else 'real'} scan {scan.id!r}: {error}") from error
