"""Comparison of a synthetic sample with a real one of a trainer's dataset, before training.

A collate function may silently accept samples of different forms: torch's takes the keys of a
batch's first sample and drops all other keys of the others.
"""

import logging
import random
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from itertools import islice
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from lidar_synth.datasets.classes import IGNORE, NAMES
from lidar_synth.errors import ConfigError
from lidar_synth.geometry import SYNTHETIC, RangeImage, Scan, Sensor, spread
from lidar_synth.geometry.projection import unproject
from lidar_synth.mixing.meaning import (
    Contradiction,
    Table,
    contradictions,
    measure_tables,
)
from lidar_synth.mixing.synthetic import Synthetic
from lidar_synth.noise import keyed_rng

log = logging.getLogger(__name__)

DEPTH = 5
"""Maximum depth of nested containers that are compared."""

PARTS = 64
"""Maximum number of elements of a sequence that are compared."""

FEW = 64
"""Maximum number of different values in an array of labels."""

SEARCHED = 8
"""Number of real samples that are searched for a value before it is reported."""

LABELS = re.compile("label|seg|sem|class|target", re.IGNORECASE)
"""Matches the names of arrays of labels."""

LEAST_POINTS = 500
"""Minimum number of rows of an array whose distribution is compared."""

MOST_COLUMNS = 16
"""Maximum number of columns of an array of points, or of channels of an image."""

UNNAMED = re.compile(r"sample(\[\d+\])*")
"""Matches the places of parts without a name, as in tuples."""

USUAL_IGNORE = (-100, -1, 254, 255, 65535)
"""Labels that mean "ignore" in common trainers, for arrays whose name does not match ``LABELS``."""


def check_alike(
    real: Sequence[Any],
    synthetic: Sequence[Synthetic],
    finish: Callable[[int, Scan, np.random.Generator], Any],
    weighs: bool,
) -> None:
    """Compare a trainer's first sample with one synthetic sample of each source, then what several
    samples mean.

    The meaning (meaning.py) is compared for points and images of ``LEAST_POINTS`` or more with
    their labels, over up to ``SEARCHED`` samples. What is certainly wrong is refused; what is
    unusual is logged as a warning.

    The state of Python's, numpy's and torch's global random generators is preserved. Banks and
    existing scans are represented by their first scan; a generator or a rolling bank, which would
    have to start first, by a made-up scan with the same fields. If either sample cannot be read,
    nothing is compared, and a warning is logged.

    Args:
        real: the trainer's datasets; the first sample of the first one is used.
        synthetic: the sources.
        finish: ``(source, scan, rng) -> sample``, what the mixture does to a scan of a source.
        weighs: whether the mixture has loss weights; samples must then be dicts with the key
            ``loss_weight``.

    Raises:
        ConfigError: if keys, types, dtypes, ranks or the value for "ignore" differ, or units, axes,
            the height of the ground, the scale of a column or the numbers of the classes.
    """
    if not real or not synthetic:
        return
    dataset = real[0]
    with _preserved_generators():
        expected = _try("real", dataset.__getitem__, 0)
        for number, source in enumerate(synthetic):
            make = partial(finish, number)
            sample = _try(
                "synthetic",
                lambda make, source: make(_scan_of(source), keyed_rng(0)),
                make,
                source,
            )
            if expected is None or sample is None:
                continue
            wrong = [
                *differences(expected, sample),
                *_unknown_values(dataset, expected, sample),
            ]
            if wrong:
                raise ConfigError(
                    f"synthetic samples unlike the real ones: {'; '.join(wrong[:4])}",
                    "the same keys, types, dtypes and ranks, and one value for ignored labels",
                    "Change to_sample, or pass compare=False if the collate function expects "
                    "them to differ.",
                )
            if weighs and not (isinstance(sample, dict) and "loss_weight" in sample):
                raise weightless()
            if _tables(expected) and not _is_on_demand(source):
                _compare_several(dataset, expected, source, make)


def weightless() -> ConfigError:
    """The error for samples that have no key for their loss weight."""
    return ConfigError(
        "loss_weight for samples without the key loss_weight",
        "dicts with that key, in which the mixture writes the weight",
        "If you multiply by train.loss_weight(i), pass compare=False.",
    )


def _compare_several(
    dataset: Any,
    first: Any,
    source: Synthetic,
    make: Callable[[Scan, np.random.Generator], Any],
) -> None:
    """Compare the meaning of several samples of a dataset with that of several of a source."""
    real = [
        _try("real", dataset.__getitem__, i)
        for i in spread(range(len(dataset)), SEARCHED)[1:]
    ]
    synthetic = [
        _try("synthetic", lambda i: make(source[i], keyed_rng(i)), i)
        for i in spread(range(source.length or SEARCHED), SEARCHED)
    ]
    report(
        compare_meaning(
            [_tables(s) for s in (first, *real)], [_tables(s) for s in synthetic]
        )
    )


def report(found: Sequence[Contradiction]) -> None:
    """Raise an error if any contradiction is certain; otherwise log all as warnings.

    Raises:
        ConfigError: if any contradiction is certain.
    """
    if any(each.certain for each in found):
        texts = [each.text for each in sorted(found, key=lambda each: not each.certain)]
        raise ConfigError(
            "synthetic samples whose values mean something else than those of real ones: "
            f"{'; '.join(texts[:4])}",
            "the same units, axes, origin, scales and classes",
            "Change to_sample (lidar-synth check-mix shows the scans themselves), or pass "
            "compare=False.",
        )
    for each in found:
        log.warning("synthetic samples are unlike the real ones: %s", each.text)


def compare_meaning(
    real: Sequence[Mapping[str, Table]], synthetic: Sequence[Mapping[str, Table]]
) -> list[Contradiction]:
    """Compare the tables of points of real and synthetic samples.

    Args:
        real, synthetic: {place: table} of each sample; tables of other places or columns are not
            compared.
    """
    found: dict[Contradiction, None] = {}
    for place, first in real[0].items():
        width = first.columns.shape[1]
        ours, theirs = (
            [
                each[place]._replace(spatial=first.spatial)
                for each in samples
                if place in each
            ]
            for samples in (synthetic, real)
        )
        ours = [table for table in ours if table.columns.shape[1] == width]
        if ours:
            measured = (
                measure_tables(theirs, USUAL_IGNORE),
                measure_tables(ours, USUAL_IGNORE),
            )
            found |= dict.fromkeys(
                contradictions(*measured, place.removeprefix("sample"))
            )
    return list(found)


def differences(
    real: Any, synthetic: Any, place: str = "sample", depth: int = DEPTH
) -> Iterator[str]:
    """Describe how a synthetic sample differs from a real one; lengths may differ, and None matches
    anything.

    Args:
        real, synthetic: two samples: mappings, sequences, tensors, arrays, numbers, text, or
            objects, of which the attributes that hold arrays are compared.
        place: name of these values within the sample.
        depth: levels of nested containers to compare.
    """
    if real is None or synthetic is None or depth == 0:
        return
    a = _kind(real)
    b = _kind(synthetic)
    if a != b:
        yield f"{place} is {b} instead of {a}"
    elif isinstance(real, Mapping):
        for key in sorted(real.keys() ^ synthetic.keys(), key=str):
            yield f"{place} has {'no' if key in real else 'an additional'} {key!r}"
        for key in [k for k in real if k in synthetic]:
            yield from differences(
                real[key], synthetic[key], f"{place}[{key!r}]", depth - 1
            )
    elif isinstance(real, list | tuple):
        if len(real) == len(synthetic):
            for i, (x, y) in enumerate(
                islice(zip(real, synthetic, strict=True), PARTS)
            ):
                yield from differences(x, y, f"{place}[{i}]", depth - 1)
        elif len({_kind(x) for x in real[:PARTS]}) > 1:
            yield f"{place} has {len(synthetic)} parts instead of {len(real)}"
        elif real and synthetic:
            yield from differences(real[0], synthetic[0], f"{place}[0]", depth - 1)
    elif a.startswith("an object"):
        x = _parts(real)
        y = _parts(synthetic)
        yield from (
            f"{place} has no {name!r}"
            for name in x
            if name not in vars(synthetic) and _is_array(x[name])
        )
        for name in [n for n in x if n in y]:
            yield from differences(x[name], y[name], f"{place}.{name}", depth - 1)


def _kind(value: Any) -> str:
    """The type of a value in words, with dtype and rank for arrays; it must be the same for two
    values."""
    if isinstance(value, torch.Tensor):
        return (
            f"a tensor of {str(value.dtype).removeprefix('torch.')}, rank {value.ndim}"
        )
    if isinstance(value, np.ndarray) and value.dtype.kind not in "OSU":
        return f"an array of {value.dtype}, rank {value.ndim}"
    for kinds, words in (
        ((bool, np.bool_), "a truth value"),
        ((int, np.integer), "an integer"),
        ((float, np.floating), "a real number"),
        (str, "text"),
        (bytes, "bytes"),
        (Mapping, "a mapping"),
        ((list, tuple), "a sequence"),
    ):
        if isinstance(value, kinds):
            return words
    return f"an object of the type {type(value).__name__}"


def _is_array(value: Any) -> bool:
    return isinstance(value, torch.Tensor | np.ndarray)


def _parts(value: Any) -> dict[str, Any]:
    """The attributes of an object that may hold arrays."""
    members = getattr(value, "__dict__", {}).items()
    return {
        k: v
        for k, v in members
        if _is_array(v)
        or isinstance(v, Mapping | list | tuple)
        or hasattr(v, "__dict__")
    }


def _unknown_values(dataset: Any, real: Any, synthetic: Any) -> Iterator[str]:
    """Describe label values of a synthetic sample that cannot be classes and occur in none of the
    first ``SEARCHED`` real samples."""
    real_labels = dict(_labels(real, np.inf))
    labels = dict(_labels(synthetic))
    for place in [p for p in labels if p in real_labels]:
        known = real_labels[place]
        if len(known) > FEW:
            # instances in the upper 16 bits
            if max(known) > 0xFFFF and len({int(v) & 0xFFFF for v in known}) <= FEW:
                yield (
                    f"{place} has {len(labels[place])} different values instead of {len(known)}: "
                    "instance ids in the upper bits? `& 0xFFFF`"
                )
            continue
        unknown = _not_classes(place, labels[place], known)
        for other in range(1, min(len(dataset), SEARCHED) if unknown else 0):
            known = known | dict(_labels(_try("real", dataset.__getitem__, other))).get(
                place, set()
            )
            unknown = _not_classes(place, unknown, known)
        if unknown:
            values = ", ".join(map(str, sorted(unknown)[:4]))
            yield (
                f"{place} holds {values}, which no real sample does "
                f"({min(known)} to {max(known)})"
            )


def _not_classes(place: str, values: set[int], known: set[int]) -> set[int]:
    """The values that cannot be classes, given the known values of real labels: "ignore", or out of
    range."""
    if not LABELS.search(place) or "inst" in place.lower():
        return {v for v in values - known if v in USUAL_IGNORE}
    low = min(0, *known)
    high = max(len(NAMES) + 1, *known)
    return {v for v in values - known if v in USUAL_IGNORE or not low <= v <= high}


def _labels(sample: Any, most: float = FEW) -> Iterator[tuple[str, set[int]]]:
    """(place, values) of the integer arrays with few different values, which may be labels."""
    for place, array in _arrays(sample):
        if array.dtype.kind in "iu" and 0 < len(values := np.unique(array)) <= most:
            yield place, set(values.tolist())


def _tables(sample: Any) -> dict[str, Table]:
    """{place: points} of the arrays of real numbers that have many rows, with the labels that
    belong to them."""
    arrays = dict(_arrays(sample))
    labels = [
        a for p, a in arrays.items() if a.dtype.kind in "iu" and _may_be_labels(p)
    ]
    tables = {}
    for place, array in arrays.items():
        rows = _rows(array) if array.dtype.kind == "f" else None
        if rows is not None:
            of_rows = (
                a.ravel()
                for a in labels
                if a.size == len(rows) and len(np.unique(a)) <= FEW
            )
            label = next(of_rows, None)
            reach = np.ptp(np.quantile(rows, (0.01, 0.99), axis=0), axis=0)
            spatial = (
                array.ndim == 2
                and len(reach) > 2
                and bool((reach[:3] > (5, 5, 0.5)).all())
            )
            tables[place] = Table(
                rows, None if label is None else label.astype(np.int64), spatial
            )
    return tables


def _may_be_labels(place: str) -> bool:
    named = LABELS.search(place.removeprefix("sample")) and "inst" not in place.lower()
    return bool(named or UNNAMED.fullmatch(place))


def _rows(array: NDArray[Any]) -> NDArray[np.float64] | None:
    """(N, C) of points (N, C), features (C, N) or an image (C, H, W); None for any other array."""
    if array.ndim in (2, 3) and 0 < len(array) <= MOST_COLUMNS:
        array = array.reshape(len(array), -1).T
    fits = (
        array.ndim == 2
        and 0 < array.shape[1] <= MOST_COLUMNS
        and len(array) >= LEAST_POINTS
    )
    return array.astype(np.float64) if fits and np.isfinite(array).all() else None


def _arrays(
    value: Any, place: str = "sample", depth: int = DEPTH
) -> Iterator[tuple[str, NDArray[Any]]]:
    """(place, array) of the arrays and tensors with at least one axis in a sample."""
    if isinstance(value, torch.Tensor):
        value = value.detach().cpu().numpy()
    if isinstance(value, np.ndarray):
        if value.ndim:
            yield place, value
    elif depth and isinstance(value, Mapping):
        for key, part in value.items():
            yield from _arrays(part, f"{place}[{key!r}]", depth - 1)
    elif depth and isinstance(value, list | tuple):
        for i, part in enumerate(value[:PARTS]):
            yield from _arrays(part, f"{place}[{i}]", depth - 1)
    elif depth:
        for name, part in _parts(value).items():
            yield from _arrays(part, f"{place}.{name}", depth - 1)


def _try(kind: str, fetch: Callable[..., Any], *which: Any) -> Any:
    """A sample, or None with a warning if it cannot be read: training will raise the same error,
    unless the dataset skips such samples."""
    try:
        return fetch(*which)
    except Exception as error:  # a trainer's own code may raise anything
        log.warning(
            "real and synthetic samples are not compared: no %s sample (%r)",
            kind,
            error,
        )
        return None


def _scan_of(source: Synthetic) -> Scan:
    """The first scan of a source, or a made-up one if the source generates scans on demand."""
    if _is_on_demand(source):
        return make_up_scan(source.sensor, source.fields)
    return source[0]


def _is_on_demand(source: Synthetic) -> bool:
    """Whether a source makes scans on demand, and would have to start first: a generator or a
    rolling bank."""
    return getattr(source, "on_demand", False) or hasattr(source, "expect")


def make_up_scan(sensor: Sensor, fields: frozenset[str]) -> Scan:
    """A scan of level ground with random labels, for checks of a scan's form.

    Args:
        sensor: defines the grid.
        fields: the fields of ``POINT_FIELDS`` that the scan has.
    """
    rng = keyed_rng(0)
    rows, columns = sensor.shape
    down = np.sin(np.maximum(-sensor.row_elevations(), 0.02))[:, None]
    distance = np.clip(1.7 / down, sensor.range_min, 0.5 * sensor.range_max).astype(
        np.float32
    )
    label = rng.choice(np.array([*range(len(NAMES)), IGNORE], np.uint8), sensor.shape)
    every: dict[str, NDArray[Any]] = {
        "reflectance": rng.random(sensor.shape, np.float32),
        "label": label,
        "raw_label": np.zeros(sensor.shape, np.uint32),
        "instance": np.zeros(sensor.shape, np.int32),
        "ring": np.broadcast_to(np.arange(rows, dtype=np.int16)[:, None], sensor.shape),
        "confidence": (label != IGNORE).astype(np.float32),
        "time": np.zeros(sensor.shape, np.float32),
        "cause": np.zeros(sensor.shape, np.uint8),
    }
    image = RangeImage(
        np.ascontiguousarray(np.broadcast_to(distance, (rows, columns))),
        sensor,
        {
            name: values
            for name, values in every.items()
            if name in fields | {"reflectance"}
        },
    )
    return replace(unproject(image), id="made-up", domain=SYNTHETIC)


@contextmanager
def _preserved_generators() -> Iterator[None]:
    """Restore the global random generators of Python, numpy and torch afterwards."""
    # numpy's legacy generator, because trainers use it.
    python, numpy = random.getstate(), np.random.get_state()  # noqa: NPY002
    devices = (
        [torch.cuda.current_device()]
        if torch.cuda.is_initialized()  # type: ignore[no-untyped-call]
        else []
    )
    with torch.random.fork_rng(devices):
        try:
            yield
        finally:
            random.setstate(python)
            np.random.set_state(numpy)  # noqa: NPY002
