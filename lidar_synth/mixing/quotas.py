"""The number of samples from each source in an epoch, and in all epochs before it.

Every epoch of a mixture has the same length, because samplers and datasets that wrap another one
ask for its length once. With ``epoch_size="add"`` that is the number of real scans and of the
synthetic ones that the largest share of the schedule adds to them, rounded up; each epoch's share
of it is rounded up too. Otherwise exact shares, which are fractions, are added up over the epochs
and only the sum is rounded: after any number of epochs, the number of synthetic samples is the
exact number, rounded up.

Several sources of a kind divide its samples by their weights in the same way. The sources are the
leaves of a binary tree, and each node sends ``round(m * share)`` of its first m samples to the left
and the rest to the right. Both numbers increase monotonically with m, so that both the counts after
m samples and the source of sample m follow from m alone.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property, lru_cache
from math import ceil
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import ConfigError, DataError, check_count
from lidar_synth.geometry.arrays import Int64Array
from lidar_synth.mixing.schedules import Schedule, Steps, constant_from, share_of
from lidar_synth.noise import check_seed

EpochSize = Literal["add", "replace"] | int
"""The length of all epochs: ``"add"`` uses every real scan once and adds synthetic ones to reach
the ratio, or the largest ratio of a schedule; where the ratio is smaller, real scans are used more
often, all equally over all epochs, so that a later epoch may use some twice and others never;
``"replace"`` has as many samples as there are real scans, some of them synthetic; a number is the
length itself."""

_FINEST = 2**30  # largest denominator of a source's share: products stay within 64 bits
_LONGEST = 10**4200  # largest denominator of a sum: Python writes up to 4300 digits
# Number of epochs of a function that determine lengths of epochs and laps.
_FIRST_EPOCHS = 100


@dataclass(frozen=True)
class PlannedSource:
    """The properties of a source of scans that determine a plan.

    Args:
        length: number of scans; None = endless.
        weight: the source's share among the sources of its kind is proportional to its weight.
            None: the length of a real source, the same weight for all synthetic ones.
        identity: text that distinguishes it from other sources; part of the plan's hash.
        block: number of consecutive scans of a synthetic source that a balanced plan uses at about
            the same time.
    """

    length: int | None
    weight: float | None = None
    identity: str = ""
    block: int = 1


@dataclass(frozen=True)
class Mixture:
    """The sources and settings that determine all plans.

    Args:
        real: sources of real scans.
        synthetic: sources of synthetic scans.
        ratio: the share of synthetic samples by epoch.
        seed: seed of the order, 0 <= seed < 2^64.
        epoch_size: see ``EpochSize``.
        reuse: number of epochs in which each synthetic scan is used.
        balanced: whether to spread synthetic samples evenly instead of shuffling them over the
            epoch. Any B consecutive samples of an epoch then hold B * ratio synthetic ones, exactly
            if that is a whole number and otherwise up to one, and every synthetic source's share of
            these up to two.

    Raises:
        ConfigError: on values with which no epoch can be planned.
        DataError: on a real source without scans.
    """

    real: tuple[PlannedSource, ...]
    synthetic: tuple[PlannedSource, ...]
    ratio: Schedule
    seed: int = 0
    epoch_size: EpochSize = "add"
    reuse: int = 1
    balanced: bool = False

    def __post_init__(self) -> None:
        size = self.epoch_size
        if size not in ("add", "replace") and not (type(size) is int and size > 0):
            raise ConfigError(
                f"epoch_size={size!r}", "'add', 'replace' or a number of samples"
            )
        check_count("reuse", self.reuse, 1)
        check_seed(self.seed)
        for source in self.real + self.synthetic:
            if source.length == 0:
                raise DataError(
                    f"a source without scans ({source.identity})", "at least one scan"
                )
            if source.weight is not None and not 0 < source.weight < float("inf"):
                raise ConfigError(
                    f"weight {source.weight} of a source", "a positive number"
                )
        if size == "add" and any(source.weight is not None for source in self.real):
            raise ConfigError(
                "weights of real sources with epoch_size='add', which uses every real scan once",
                "no weights, or another epoch_size",
                "Use epoch_size='replace' or a number of samples.",
            )
        for epoch in (0, *self._deciding):
            exact_synthetic(self, epoch)  # raises if the sources cannot serve it

    @property
    def real_length(self) -> int:
        """Number of scans in all real sources together."""
        return sum(source.length or 0 for source in self.real)

    @cached_property
    def real_weights(self) -> tuple[Fraction, ...]:
        """The weights of the real sources, by default their lengths."""
        return tuple(
            _exact(s.length or 0 if s.weight is None else s.weight) for s in self.real
        )

    @cached_property
    def synthetic_weights(self) -> tuple[Fraction, ...]:
        """The weights of the synthetic sources, by default all equal."""
        return tuple(
            _exact(1 if s.weight is None else s.weight) for s in self.synthetic
        )

    @cached_property
    def laps(self) -> tuple[int, ...]:
        """For each synthetic source, the largest number of scans that an epoch takes from it, at
        least 1.

        With ``reuse``, scans come in laps of this length, so that no epoch contains a scan twice.
        """
        most = max(ceil(exact_synthetic(self, epoch)) for epoch in self._deciding)
        return tuple(
            max(1, lap) for lap in _largest_counts(_tree(self.synthetic_weights), most)
        )

    @cached_property
    def length(self) -> int:
        """Number of samples in an epoch, the same in all of them.

        Raises:
            ConfigError: on ``epoch_size="add"`` with a ratio of 1, which no number of synthetic
                samples reaches.
        """
        if self.epoch_size != "add":
            if self.epoch_size == "replace":
                return self.real_length
            return int(self.epoch_size)
        share, epoch = max(
            (share_of(self.ratio, epoch), -epoch) for epoch in self._deciding
        )
        if share == 1:
            raise ConfigError(
                f"ratio 1 in epoch {-epoch} with epoch_size='add', which keeps every real scan",
                "a ratio below 1",
                "Use epoch_size='replace' or a number of samples.",
            )
        return self.real_length + ceil(self.real_length * share / (1 - share))

    @cached_property
    def _deciding(self) -> tuple[int, ...]:
        """The epochs that are checked and that determine lengths: all in which the ratio changes;
        of a function, the first hundred and that from which on it is constant."""
        if isinstance(self.ratio, Steps):
            return self.ratio.changes
        last = constant_from(self.ratio)
        planned = []
        with suppress(ConfigError):  # the schedule ends
            for epoch in (*range(_FIRST_EPOCHS)[:last], last or 0):
                share_of(self.ratio, epoch)
                planned.append(epoch)
        return tuple(planned)

    @cached_property
    def _sums(self) -> dict[int, Fraction]:
        """A cache: {epoch: exact number of synthetic samples before it}."""
        return {0: Fraction(0)}


def exact_synthetic(mixture: Mixture, epoch: int) -> Fraction:
    """The number of synthetic samples that an epoch should have, before rounding.

    Raises:
        ConfigError: if the sources cannot serve the ratio.
        DataError: if the ratio needs real scans and there are none.
    """
    share = share_of(mixture.ratio, epoch)
    size = mixture.epoch_size
    if share > 0 and not mixture.synthetic:
        raise ConfigError(
            f"ratio {float(share):g} in epoch {epoch} without a synthetic source",
            "one, or ratio 0",
        )
    if not mixture.real_length and (share < 1 or not isinstance(size, int)):
        raise DataError(
            f"no real scans, with ratio {float(share):g} in epoch {epoch} and epoch_size={size!r}",
            "a real source with scans",
            "For synthetic scans only, use ratio=1 and set epoch_size to the number of samples.",
        )
    exact = mixture.length * share
    return Fraction(ceil(exact)) if size == "add" else exact


def synthetic_before(mixture: Mixture, epoch: int) -> Fraction:
    """The number of synthetic samples that all epochs before this one should have together, before
    rounding."""
    same_from = constant_from(mixture.ratio)
    changing = epoch if same_from is None else min(epoch, same_from)
    sums = mixture._sums
    for earlier in range(len(sums) - 1, changing):
        total = sums[earlier] + exact_synthetic(mixture, earlier)
        sums[earlier + 1] = total.limit_denominator(_LONGEST)
    total = sums[changing]
    if epoch == changing:
        return total
    return total + (epoch - changing) * exact_synthetic(mixture, changing)


def count_before(mixture: Mixture, epoch: int) -> tuple[int, ...]:
    """The number of samples from each source in all epochs before this one together, real sources
    first."""
    synthetic = ceil(synthetic_before(mixture, epoch))
    reals = split(mixture.real_weights, epoch * mixture.length - synthetic)
    return reals + split(mixture.synthetic_weights, synthetic)


def count_samples(mixture: Mixture, epoch: int) -> tuple[int, ...]:
    """The number of samples from each source in an epoch, real sources first; their sum is the
    epoch's length.

    Raises:
        ConfigError: if the sources cannot serve the ratio.
        DataError: if the ratio needs real scans and there are none.
    """
    exact_synthetic(mixture, epoch)  # raises if the schedule has no such epoch
    before = count_before(mixture, epoch)
    after = count_before(mixture, epoch + 1)
    return tuple(b - a for a, b in zip(before, after, strict=True))


@dataclass(frozen=True)
class _Node:
    """Sends ``round(m * p / q)`` of its first m samples to the left, the others right; a leaf is a
    source's number."""

    p: int
    q: int
    left: "_Node | int"
    right: "_Node | int"


Number = TypeVar("Number", int, Int64Array)


def split(weights: Sequence[Fraction], total: int) -> tuple[int, ...]:
    """Divide the first ``total`` samples among the sources.

    The counts sum to ``total`` and increase monotonically with it. With up to four sources each is
    within one of its exact share (the error at depth 2 is less than 1/2 + 1/2); with n sources,
    within ``log2(n) / 2`` rounded up.
    """
    counts = [0] * len(weights)

    def walk(node: _Node | int, count: int) -> None:
        if isinstance(node, int):
            counts[node] = count
        else:
            left = _left(node, count)
            walk(node.left, left)
            walk(node.right, count - left)

    if weights:
        walk(_tree(tuple(weights)), total)
    return tuple(counts)


def deal(
    weights: Sequence[Fraction], samples: Int64Array
) -> tuple[Int64Array, Int64Array]:
    """The source of each sample, and its number within that source; consistent with ``split``.

    Args:
        weights: of the sources.
        samples: (N,) numbers of samples, from 0.

    Returns:
        (N,) sources, (N,) numbers within them.
    """
    sources = np.empty_like(samples)
    numbers = np.empty_like(samples)

    def walk(node: _Node | int, where: NDArray[np.intp], number: Int64Array) -> None:
        if isinstance(node, int):
            sources[where] = node
            numbers[where] = number
        else:
            left = _left(node, number)
            goes_left = _left(node, number + 1) > left
            walk(node.left, where[goes_left], left[goes_left])
            walk(node.right, where[~goes_left], (number - left)[~goes_left])

    walk(_tree(tuple(weights)), np.arange(len(samples)), samples)
    return sources, numbers


def _left(node: _Node, count: Number) -> Number:
    """``round(count * p / q)``, halves up."""
    quotient = count // node.q
    rest = count % node.q
    return quotient * node.p + (2 * rest * node.p + node.q) // (2 * node.q)


def _largest_counts(node: _Node | int, count: int) -> tuple[int, ...]:
    """The largest number of samples that each source, in order, can get out of ``count``
    consecutive ones."""
    most: dict[int, int] = {}

    def walk(node: _Node | int, count: int) -> None:
        if isinstance(node, int):
            most[node] = count
        else:
            walk(node.left, ceil(Fraction(count * node.p, node.q)))
            walk(node.right, ceil(Fraction(count * (node.q - node.p), node.q)))

    walk(node, count)
    return tuple(count for _, count in sorted(most.items()))


@lru_cache(256)
def _tree(weights: tuple[Fraction, ...]) -> _Node | int:
    """A balanced binary tree, the heaviest sources first, because the first leaves have the fewest
    roundings."""

    def grow(sources: Sequence[int]) -> _Node | int:
        if len(sources) == 1:
            return sources[0]
        left = sources[: len(sources) // 2]
        right = sources[len(sources) // 2 :]
        share = sum((weights[i] for i in left), Fraction(0)) / sum(
            weights[i] for i in sources
        )
        p, q = share.limit_denominator(_FINEST).as_integer_ratio()
        return _Node(p, q, grow(left), grow(right))

    return grow(sorted(range(len(weights)), key=lambda i: -weights[i]))


def _exact(value: Any) -> Fraction:
    """The fraction of a number's decimal text: 0.1 is exactly one tenth."""
    return Fraction(repr(float(value)))
