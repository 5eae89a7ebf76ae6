"""Whether synthetic samples have the form of a trainer's real ones: one of each is compared before training.

What a collate function makes of samples that differ is its own affair, and silent at times: torch's takes the keys of
a batch's first sample and drops what the others have beside them.
"""

import logging
import random
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from lidar_synth.datasets.classes import IGNORE, NAMES
from lidar_synth.errors import ConfigError
from lidar_synth.geometry.projection import unproject
from lidar_synth.geometry.scan import SYNTHETIC, RangeImage, Scan
from lidar_synth.geometry.sensor import Sensor
from lidar_synth.mixing.synthetic import Generated, Synthetic
from lidar_synth.noise import keyed_rng

log = logging.getLogger(__name__)

DEPTH = 5
"""Containers within containers that are looked into."""

PARTS = 64
"""Parts of a sequence that are looked at."""

FEW = 64
"""Different values that an array of labels holds at most."""

LOOKED_AT = 8
"""Real samples that may be asked for a value before it is called strange."""

LABELS = re.compile("label|seg|sem|class|target", re.IGNORECASE)
"""Names of arrays of labels."""

USUAL_IGNORE = (-100, -1, 254, 255, 65535)
"""What stands for "ignore" in common trainers, where an array's name does not say that it holds labels."""


def check_alike(
    real: Sequence[Any], synthetic: Sequence[Synthetic], finish: Callable[[int, Scan, np.random.Generator], Any]
) -> None:
    """Compare a trainer's first sample with a synthetic one of each source.

    The state of Python's, numpy's and torch's global generators is kept. A bank or held scans give their first scan;
    in place of a generator or a rolling bank, which would have to start, stands a made-up scan with the same fields.
    Where either sample cannot be had, nothing is compared, and the log says so.

    Args:
        real: the trainer's datasets; the first sample of the first one is taken.
        synthetic: the sources.
        finish: ``(source, scan, rng) -> sample``, what the mixture does to a scan of a source.

    Raises:
        ConfigError: where keys, types, dtypes, ranks or what stands for "ignore" differ.
    """
    if not real or not synthetic:
        return
    dataset = real[0]
    with _generators_kept():
        expected = _try("real", dataset.__getitem__, 0)
        for number, source in enumerate(synthetic):
            given = _try("synthetic", lambda n, s: finish(n, _scan_of(s), keyed_rng(0)), number, source)
            if expected is None or given is None:
                continue
            wrong = [*differences(expected, given), *_strange_values(dataset, expected, given)]
            if wrong:
                raise ConfigError(
                    f"synthetic samples unlike the real ones: {'; '.join(wrong[:4])}",
                    "the same keys, types, dtypes and ranks, and one value for ignored labels",
                    "Change to_sample, or pass compare=False where the collate function wants them to differ.",
                )


def differences(real: Any, synthetic: Any, place: str = "sample", depth: int = DEPTH) -> Iterator[str]:
    """What a synthetic sample has otherwise than a real one, in words; lengths may differ, and None is like anything.

    Args:
        real, synthetic: what two datasets give: mappings, sequences, tensors, arrays, numbers, text, or objects, whose
            attributes that hold arrays count.
        place: where in the sample they stand.
        depth: containers to look into.
    """
    if real is None or synthetic is None or depth == 0:
        return
    a, b = _kind(real), _kind(synthetic)
    if a != b:
        yield f"{place} is {b} instead of {a}"
    elif isinstance(real, Mapping):
        for key in sorted(real.keys() ^ synthetic.keys(), key=str):
            yield f"{place} has {'no' if key in real else 'an additional'} {key!r}"
        for key in [k for k in real if k in synthetic]:
            yield from differences(real[key], synthetic[key], f"{place}[{key!r}]", depth - 1)
    elif isinstance(real, list | tuple):
        if len(real) == len(synthetic):
            for i, (x, y) in enumerate(islice(zip(real, synthetic, strict=True), PARTS)):
                yield from differences(x, y, f"{place}[{i}]", depth - 1)
        elif len({_kind(x) for x in real[:PARTS]}) > 1:
            yield f"{place} has {len(synthetic)} parts instead of {len(real)}"
        elif real and synthetic:
            yield from differences(real[0], synthetic[0], f"{place}[0]", depth - 1)
    elif a.startswith("an object"):
        x, y = _parts(real), _parts(synthetic)
        yield from (f"{place} has no {name!r}" for name in x if name not in vars(synthetic) and _is_array(x[name]))
        for name in [n for n in x if n in y]:
            yield from differences(x[name], y[name], f"{place}.{name}", depth - 1)


def _kind(value: Any) -> str:
    """What has to be the same of two values, in words."""
    if isinstance(value, torch.Tensor):
        return f"a tensor of {str(value.dtype).removeprefix('torch.')}, rank {value.ndim}"
    if isinstance(value, np.ndarray) and value.dtype.kind not in "OSU":
        return f"an array of {value.dtype}, rank {value.ndim}"
    for kinds, words in (
        ((bool, np.bool_), "a truth value"), ((int, np.integer), "an integer"), ((float, np.floating), "a real number"),
        (str, "text"), (bytes, "bytes"), (Mapping, "a mapping"), ((list, tuple), "a sequence"),
    ):  # fmt: skip
        if isinstance(value, kinds):
            return words
    return f"an object of the type {type(value).__name__}"


def _is_array(value: Any) -> bool:
    return isinstance(value, torch.Tensor | np.ndarray)


def _parts(value: Any) -> dict[str, Any]:
    """The attributes of an object that may hold arrays."""
    held = getattr(value, "__dict__", {})
    return {
        k: v for k, v in held.items() if _is_array(v) or isinstance(v, Mapping | list | tuple) or hasattr(v, "__dict__")
    }


def _strange_values(dataset: Any, real: Any, synthetic: Any) -> Iterator[str]:
    """Values in a synthetic sample's labels that no real sample looked at has and that are no class."""
    shown, given = dict(_labels(real)), dict(_labels(synthetic))
    for place in [p for p in given if p in shown]:
        known = shown[place]
        strange = _no_classes(place, given[place], known)
        for other in range(1, min(len(dataset), LOOKED_AT) if strange else 0):
            known = known | dict(_labels(_try("real", dataset.__getitem__, other))).get(place, set())
            strange = _no_classes(place, strange, known)
        if strange:
            values = ", ".join(map(str, sorted(strange)[:4]))
            yield f"{place} holds {values}, and none of the real ones does ({min(known)} to {max(known)})"


def _no_classes(place: str, values: set[int], known: set[int]) -> set[int]:
    """Those of the values that stand for "ignore", or for nothing, where real labels have the known ones."""
    if not LABELS.search(place) or "inst" in place.lower():
        return {v for v in values - known if v in USUAL_IGNORE}
    low, high = min(0, *known), max(len(NAMES) + 1, *known)
    return {v for v in values - known if v in USUAL_IGNORE or not low <= v <= high}


def _labels(value: Any, place: str = "sample", depth: int = DEPTH) -> Iterator[tuple[str, set[int]]]:
    """(place, values) of the arrays of integers that can be labels: few different ones."""
    if isinstance(value, torch.Tensor):
        value = value.detach().cpu().numpy()
    if isinstance(value, np.ndarray):
        if value.ndim and value.dtype.kind in "iu" and 0 < len(values := np.unique(value)) <= FEW:
            yield place, set(values.tolist())
    elif depth and isinstance(value, Mapping):
        for key, held in value.items():
            yield from _labels(held, f"{place}[{key!r}]", depth - 1)
    elif depth and isinstance(value, list | tuple):
        for i, held in enumerate(value[:PARTS]):
            yield from _labels(held, f"{place}[{i}]", depth - 1)
    elif depth:
        for name, held in _parts(value).items():
            yield from _labels(held, f"{place}.{name}", depth - 1)


def _try(kind: str, fetch: Callable[..., Any], *which: Any) -> Any:
    """A sample, or None where it cannot be had: training will meet the reason, and some datasets pass over it."""
    try:
        return fetch(*which)
    except Exception as error:  # a trainer's own code: anything may come
        log.warning("real and synthetic samples are not compared: no %s sample (%r)", kind, error)
        return None


def _scan_of(source: Synthetic) -> Scan:
    """A scan of a source, or one like it where making it takes long or counts."""
    if isinstance(source, Generated) or hasattr(source, "expect"):
        return made_up(source.sensor, source.fields)
    return source[0]


def made_up(sensor: Sensor, fields: frozenset[str]) -> Scan:
    """A scan of level ground with all labels on it, for what looks at a scan's form.

    Args:
        sensor: whose grid.
        fields: which of ``POINT_FIELDS`` it has.
    """
    rng, (rows, columns) = keyed_rng(0), sensor.shape
    down = np.sin(np.maximum(-sensor.row_elevations(), 0.02))[:, None]
    distance = np.clip(1.7 / down, sensor.range_min, 0.5 * sensor.range_max).astype(np.float32)
    label = rng.choice(np.array([*range(len(NAMES)), IGNORE], np.uint8), sensor.shape)
    every: dict[str, NDArray[Any]] = {
        "reflectance": rng.random(sensor.shape, np.float32),
        "label": label,
        "raw_label": np.zeros(sensor.shape, np.uint32),
        "instance": np.zeros(sensor.shape, np.int32),
        "ring": np.broadcast_to(np.arange(rows, dtype=np.int16)[:, None], sensor.shape),
        "confidence": (label != IGNORE).astype(np.float32),
    }
    image = RangeImage(
        np.ascontiguousarray(np.broadcast_to(distance, (rows, columns))),
        sensor,
        {name: values for name, values in every.items() if name in fields | {"reflectance"}},
    )
    return replace(unproject(image), id="made-up", domain=SYNTHETIC)


@contextmanager
def _generators_kept() -> Iterator[None]:
    """Leave the global generators of Python, numpy and torch as they were."""
    python, numpy = random.getstate(), np.random.get_state()  # noqa: NPY002 - what a trainer draws from
    devices = [torch.cuda.current_device()] if torch.cuda.is_initialized() else []  # type: ignore[no-untyped-call]
    with torch.random.fork_rng(devices):
        try:
            yield
        finally:
            random.setstate(python)
            np.random.set_state(numpy)  # noqa: NPY002
