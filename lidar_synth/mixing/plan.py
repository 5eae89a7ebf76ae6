"""Which sample stands where: the plan of an epoch as a pure function of the mixture and the epoch.

Nothing is drawn at random along the way. Quotas are exact (Hamilton's method of largest remainders) and the order is
a permutation keyed by (seed, epoch), so that workers, ranks, batch size and resumption cannot change what is given.

Two running counts over the epochs make local indices. Real scans follow one another through endless permutations of
their source: after any number of epochs each was given equally often, up to one. Synthetic scans are counted up, so
that they are fresh; with ``reuse = k``, ``k`` counts in a row fall on one scan.
"""

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import floor
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.mixing.schedules import Schedule, settled, share_of
from lidar_synth.noise import uniform

VERSION = "lidar-synth-plan/1"
"""Part of every plan's hash; changes when the same mixture gives another order."""

EpochSize = Literal["add", "replace"] | int
"""How long an epoch is: ``"add"`` gives every real scan once and adds synthetic ones until the ratio holds;
``"replace"`` keeps the number of real scans as the length and gives synthetic ones in the place of some; a number is
the length."""

_DOMAINS, _REALS, _SYNTHETICS, _SOURCES = range(4)  # streams of random numbers; each source has one of its own
_STREAM = 1 << 48  # what keeps them apart: far more than the epochs of a run


@dataclass(frozen=True)
class Part:
    """A source of scans as the plan sees it.

    Args:
        length: how many scans there are; None = endless.
        weight: its share among the sources of its kind is proportional to this; None = by its length (real) or
            the same for each (synthetic).
        identity: what tells it from other sources; goes into the plan's hash.
    """

    length: int | None
    weight: float | None = None
    identity: str = ""


@dataclass(frozen=True)
class Mixture:
    """What a plan is made of.

    Args:
        real: sources of real scans.
        synthetic: sources of synthetic scans.
        ratio: the share of synthetic samples by epoch.
        seed: of the order, 0 <= seed < 2^64.
        epoch_size: see ``EpochSize``.
        reuse: how often a synthetic scan is given.
        balanced: spread synthetic samples evenly, so that any B samples in a row hold B times the ratio of them, up
            to one, and exactly where that is a whole number; otherwise they are shuffled over the epoch.

    Raises:
        ConfigError: on values that no epoch can be planned with.
        DataError: on a real source without scans.
    """

    real: tuple[Part, ...]
    synthetic: tuple[Part, ...]
    ratio: Schedule
    seed: int = 0
    epoch_size: EpochSize = "add"
    reuse: int = 1
    balanced: bool = False

    def __post_init__(self) -> None:
        size = self.epoch_size
        if size not in ("add", "replace") and not (isinstance(size, int) and not isinstance(size, bool) and size > 0):
            raise ConfigError(f"epoch_size={size!r}", "'add', 'replace' or a number of samples")
        if self.reuse < 1:
            raise ConfigError(f"reuse={self.reuse}", "how often a synthetic scan is given, at least 1")
        if not 0 <= self.seed < 2**64:
            raise ConfigError(f"seed {self.seed}", "0 <= seed < 2^64")
        for part in self.real + self.synthetic:
            if part.length == 0:
                raise DataError(f"a source without scans ({part.identity})", "at least one scan")
            if part.weight is not None and not 0 < part.weight < float("inf"):
                raise ConfigError(f"weight {part.weight} of a source", "a positive number")
        if size == "add" and any(part.weight is not None for part in self.real):
            raise ConfigError(
                "weights of real sources with epoch_size='add', which gives every real scan once",
                "no weights, or another epoch_size",
                "Use epoch_size='replace' or a number of samples.",
            )
        quotas(self, 0)

    @property
    def real_length(self) -> int:
        """Scans of all real sources together."""
        return sum(part.length or 0 for part in self.real)


@dataclass(frozen=True)
class Plan:
    """An epoch: what stands at each of its N positions.

    Args:
        source: (N,) int32, number of the source: the real ones in order, then the synthetic ones.
        index: (N,) int64, local index in that source.
        reals: how many real sources there are.
        hash: sha256 of all this and of the sources' identities, in hexadecimal.
    """

    source: NDArray[np.int32]
    index: NDArray[np.int64]
    reals: int
    hash: str

    def __len__(self) -> int:
        return len(self.source)

    @property
    def domain(self) -> NDArray[np.bool_]:
        """(N,) where a synthetic sample stands."""
        synthetic: NDArray[np.bool_] = self.source >= self.reals
        return synthetic


def plan(mixture: Mixture, epoch: int) -> Plan:
    """The plan of an epoch.

    Args:
        mixture: of sources.
        epoch: 0 <= epoch < 2^40.

    Raises:
        ConfigError: on an epoch for which there is no ratio, or none that the sources can serve.
    """
    counts, before = quotas(mixture, epoch), running_counts(mixture, epoch)
    reals, total = len(mixture.real), sum(counts)
    synthetic = _domains(mixture, epoch, total, sum(counts[reals:]))
    source, index = np.empty(total, np.int32), np.empty(total, np.int64)
    for where, first, last, stream in (~synthetic, 0, reals, _REALS), (synthetic, reals, len(counts), _SYNTHETICS):
        dealt = np.repeat(np.arange(first, last, dtype=np.int32), np.array(counts[first:last], np.int64))
        source[where] = dealt[_permutation(mixture.seed, stream, epoch, len(dealt))]
    for number, part in enumerate(mixture.real + mixture.synthetic):
        numbers = before[number] + np.arange(counts[number], dtype=np.int64)
        stream = _SOURCES + number
        if number < reals:
            local = _through_permutations(mixture.seed, stream, numbers, part.length or 0)
        else:
            local = numbers[_permutation(mixture.seed, stream, epoch, len(numbers))] // mixture.reuse
            local = local if part.length is None else local % part.length
        index[source == number] = local
    return Plan(source, index, reals, _hash(mixture, source, index))


def quotas(mixture: Mixture, epoch: int) -> tuple[int, ...]:
    """How many samples of each source an epoch gives, real sources first; their sum is its length.

    Raises:
        ConfigError: where the ratio cannot be kept with these sources.
        DataError: where there are no real scans to keep it.
    """
    share, size = share_of(mixture.ratio, epoch), mixture.epoch_size
    real = mixture.real_length
    if share > 0 and not mixture.synthetic:
        raise ConfigError(f"ratio {float(share):g} in epoch {epoch} without a synthetic source", "one, or ratio 0")
    if not real and (share < 1 or not isinstance(size, int)):
        raise DataError(
            f"no real scans, with ratio {float(share):g} and epoch_size={size!r}",
            "a real source with scans",
            "For synthetic scans only, use ratio=1 and give epoch_size the number of samples.",
        )
    if size == "add":
        if share == 1:
            raise ConfigError(
                f"ratio 1 in epoch {epoch} with epoch_size='add', which keeps every real scan",
                "a ratio below 1",
                "Use epoch_size='replace' or a number of samples.",
            )
        lengths = tuple(part.length or 0 for part in mixture.real)
        return lengths + _shared_out(mixture.synthetic, _rounded(real * share / (1 - share)), _alike)
    total = real if size == "replace" else int(size)
    synthetic = _rounded(total * share)
    by_length = _shared_out(mixture.real, total - synthetic, lambda part: float(part.length or 0))
    return by_length + _shared_out(mixture.synthetic, synthetic, _alike)


def running_counts(mixture: Mixture, epoch: int) -> tuple[int, ...]:
    """How many samples of each source all epochs before this one give together."""
    same_from = settled(mixture.ratio)
    changing = epoch if same_from is None else min(epoch, same_from)
    sums = [0] * len(mixture.real + mixture.synthetic)
    for earlier in range(changing):
        sums = [a + b for a, b in zip(sums, quotas(mixture, earlier), strict=True)]
    if epoch > changing:
        sums = [a + (epoch - changing) * b for a, b in zip(sums, quotas(mixture, changing), strict=True)]
    return tuple(sums)


def largest_remainders(total: int, weights: Sequence[Fraction]) -> tuple[int, ...]:
    """Whole numbers in proportion to weights whose sum is ``total``; among equal remainders, the first wins."""
    exact = [total * w / sum(weights) for w in weights]  # none for no weights
    counts = [floor(e) for e in exact]
    by_remainder = sorted(range(len(exact)), key=lambda i: counts[i] - exact[i])
    for i in by_remainder[: total - sum(counts)]:
        counts[i] += 1
    return tuple(counts)


def _shared_out(parts: Sequence[Part], total: int, default: Callable[[Part], float]) -> tuple[int, ...]:
    weights = [part.weight if part.weight is not None else default(part) for part in parts]
    return largest_remainders(total, [Fraction(repr(float(w))) for w in weights])


def _alike(part: Part) -> float:
    return 1.0


def _rounded(value: Fraction) -> int:
    return floor(value + Fraction(1, 2))


def _domains(mixture: Mixture, epoch: int, total: int, synthetic: int) -> NDArray[np.bool_]:
    """(N,) which positions are synthetic."""
    if mixture.balanced:
        # Where the rounded share of the positions so far rises by one.
        p, q = share_of(mixture.ratio, epoch).as_integer_ratio()
        so_far = (2 * np.arange(total + 1, dtype=np.int64) * p + q) // (2 * q)
        return np.diff(so_far) > 0
    chosen = np.zeros(total, bool)
    chosen[_permutation(mixture.seed, _DOMAINS, epoch, total)[:synthetic]] = True
    return chosen


def _through_permutations(seed: int, stream: int, numbers: NDArray[np.int64], length: int) -> NDArray[np.int64]:
    """Where running numbers lead in one permutation of a source after another."""
    if not len(numbers):
        return numbers
    rounds = range(int(numbers[0]) // length, int(numbers[-1]) // length + 1)
    orders = np.concatenate([_permutation(seed, stream, r, length) for r in rounds])
    return orders[numbers - rounds[0] * length]


def _permutation(seed: int, stream: int, number: int, count: int) -> NDArray[np.int64]:
    """(count,) an order that follows from the seed, the stream and the number alone, on every machine."""
    if not count:
        return np.empty(0, np.int64)
    keys = uniform(seed, [stream * _STREAM + number], (count,))[0].numpy()
    return np.argsort(keys, kind="stable")


def _hash(mixture: Mixture, source: NDArray[np.int32], index: NDArray[np.int64]) -> str:
    identities = [part.identity for part in mixture.real + mixture.synthetic]
    digest = hashlib.sha256(json.dumps([VERSION, mixture.seed, len(mixture.real), identities]).encode())
    digest.update(source.astype("<i4").tobytes())
    digest.update(index.astype("<i8").tobytes())
    return digest.hexdigest()
