"""Two sets of scans compared by a named protocol, and by the features of any extractor."""

import warnings
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.geometry import Source, check_source
from lidar_synth.lab.evaluate.cache import extract_all
from lidar_synth.lab.evaluate.features import Extractor, find_weights, load_published
from lidar_synth.lab.evaluate.leakage import refuse_training_data
from lidar_synth.lab.evaluate.loop_metric import Metric, Score, choice
from lidar_synth.lab.evaluate.protocols import Protocol, find_protocol
from lidar_synth.lab.evaluate.reading import readable


def evaluate(
    real: Source,
    generated: Source,
    protocol: str | Protocol,
    extractors: Mapping[str, Extractor] | None = None,
    batch: int = 16,
    progress: bool = True,
    *,
    weights: Path | None = None,
    replicates: int = 0,
    extended: bool = False,
    anyway: bool = False,
    training_data: bool = False,
    cache: Path | None = None,
    processes: int = 1,
    left_out: dict[str, str] | None = None,
) -> list[Score]:
    """Compare two sets of scans.

    Args:
        real: real scans.
        generated: generated scans.
        protocol: a name of ``PROTOCOLS``, or a protocol.
        extractors: feature extractors by name; each adds a Frechet distance and a squared maximum
            mean discrepancy.
        batch: number of scans that extractors process at a time.
        progress: whether to show a progress bar.
        weights: folder with the published weights of the protocol's extractors; by default the one
            that LIDAR_SYNTH_METRICS names. Measures without weights are left out.
        replicates: resamples for a 95 % interval of each value; 0 = no intervals.
        extended: add unbiased forms, precision, recall, density and coverage of all features.
        anyway: whether to compare fewer scans than the protocol's paper, and scans of
            sensors that differ.
        training_data: whether to compare with scans on which the model of the generated
            ones was trained.
        cache: folder in which features of published weights are kept, by the hash of scan and
            weights.
        processes: number of processes that extract these features; more than one need a ``cache``.
        left_out: filled with {measure: why it was left out}.

    Raises:
        ConfigError: on a path, which ``open_scans`` opens, an unknown protocol, several processes
            without a cache, or real scans that the model has seen; see
            ``leakage.refuse_training_data``.
        DataError: on an empty set, a scan without returns in the protocol's area, or, without
            ``anyway``, fewer scans than the paper's or sensors that differ.

    Example:
        >>> from lidar_synth import Town, evaluate
        >>> scores = evaluate(Town(1, scans=2), Town(2, scans=2), "town", progress=False)
        >>> [score.metric for score in scores]
        ['BEV Jensen-Shannon distance', 'BEV maximum mean discrepancy']
    """
    for scans in (real, generated):
        check_source(scans)
    rules = find_protocol(protocol)
    if not anyway:
        check_counts(rules, len(real), len(generated))
    if not training_data and (note := refuse_training_data(real, generated)):
        warnings.warn(note, stacklevel=2)
    if replicates and min(len(real), len(generated)) < 2:
        raise DataError(
            f"{len(real)} real and {len(generated)} generated scans",
            "at least two of each for an interval",
        )
    metric = Metric(
        rules, extractors, weights, replicates, extended, anyway, batch, cache
    )
    if processes > 1:
        _fill(rules, (real, generated), weights, cache, processes, batch)
    indices: Sequence[int] = range(len(real))
    if (
        not extractors
        and not metric.uses_weights
        and rules.limit is not None
        and len(real) > rules.limit
    ):
        indices = choice(len(real), rules.limit)
    metric.update(readable(real, indices, "real scans", progress), real=True)
    metric.update(readable(generated, None, "generated scans", progress), real=False)
    scores = metric.scores()
    if left_out is not None:
        left_out |= metric.left_out
    return scores


def check_counts(protocol: Protocol, real: int, generated: int) -> None:
    """Refuse sets that are smaller than those of the protocol's paper.

    Raises:
        DataError: with fewer scans.
    """
    for name, count, least in (
        ("real", real, protocol.needs.real),
        ("generated", generated, protocol.needs.generated),
    ):
        if least is not None and count < least:
            raise DataError(
                f"{count} {name} scans",
                f"{least}, as the {protocol.name} protocol compares them",
                "anyway=True (--anyway) measures them; the figures do not stand beside the "
                "paper's.",
            )


def _fill(
    protocol: Protocol,
    sets: tuple[Source, Source],
    weights: Path | None,
    cache: Path | None,
    processes: int,
    batch: int,
) -> None:
    """Extract the features of both sets into the cache by several processes."""
    if cache is None:
        raise ConfigError(
            f"{processes} processes without a cache",
            "a folder that they share",
            "Add --cache FOLDER.",
        )
    for measure in protocol.measures.values():
        path = find_weights(measure.extractor, weights) if measure.extractor else None
        if path is not None:
            for source, generated in zip(sets, (False, True), strict=True):
                extract_all(
                    partial(load_published, measure, path, cache),
                    source,
                    processes,
                    batch,
                    (generated,),
                )
