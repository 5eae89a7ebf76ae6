"""How many samples of each source an epoch gives, and how many all epochs before it gave.

Exact shares are fractions. They are added up over the epochs and only the sum is rounded, so that what one epoch has
too little of, a later one gets: after any number of epochs, the synthetic samples are the exact number, rounded up.

Several sources of a kind share its samples by their weights in the same way. The sources stand at the leaves of a
binary tree, and at each node the first m samples divide into ``round(m * share)`` to the left and the rest to the
right. Both numbers only rise with m, so that the tree deals samples one by one, and both the counts after m samples
and the source of sample m follow from m alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property, lru_cache
from math import ceil
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.mixing.schedules import Schedule, settled, share_of

EpochSize = Literal["add", "replace"] | int
"""How long an epoch is: ``"add"`` gives every real scan once and adds synthetic ones until the ratio holds;
``"replace"`` keeps the number of real scans as the length and gives synthetic ones in the place of some; a number is
the length."""

_FINEST = 2**30  # largest denominator of a source's share: products stay within 64 bits
_LOOKED_AT = 100  # epochs of a changing schedule that tell how long a lap is


@dataclass(frozen=True)
class PlannedSource:
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
        reuse: how often a synthetic scan is given, in as many epochs.
        balanced: spread synthetic samples evenly, so that any B samples in a row of an epoch hold B times the ratio of
            them, up to one, and exactly where that is a whole number, and every synthetic source's share of them, up
            to two; otherwise they are shuffled over the epoch.

    Raises:
        ConfigError: on values that no epoch can be planned with.
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

    @cached_property
    def real_weights(self) -> tuple[Fraction, ...]:
        """What real sources count, by default their lengths."""
        return tuple(_exact(part.length or 0 if part.weight is None else part.weight) for part in self.real)

    @cached_property
    def synthetic_weights(self) -> tuple[Fraction, ...]:
        """What synthetic sources count, by default all the same."""
        return tuple(_exact(1 if part.weight is None else part.weight) for part in self.synthetic)

    @cached_property
    def laps(self) -> tuple[int, ...]:
        """For each synthetic source, the most scans that an epoch takes of it, at least 1.

        With ``reuse`` its scans come in laps of this length, so that no epoch has one of them twice. A schedule that
        is a function is asked for its first hundred epochs.
        """
        last = settled(self.ratio)
        epochs = [*range(_LOOKED_AT if last is None else min(last, _LOOKED_AT)), last or 0]
        exact = [Fraction(0)]
        for epoch in epochs:
            try:
                exact.append(exact_synthetic(self, epoch))
            except ConfigError:  # the schedule ends here
                break
        return tuple(max(1, lap) for lap in _most(_tree(self.synthetic_weights), ceil(max(exact))))

    @cached_property
    def _sums(self) -> dict[int, Fraction]:
        """By epoch, the exact number of synthetic samples before it, as far as it was asked for."""
        return {0: Fraction(0)}


def exact_synthetic(mixture: Mixture, epoch: int) -> Fraction:
    """How many synthetic samples an epoch should give, before rounding.

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
    if size != "add":
        return (real if size == "replace" else int(size)) * share
    if share == 1:
        raise ConfigError(
            f"ratio 1 in epoch {epoch} with epoch_size='add', which keeps every real scan",
            "a ratio below 1",
            "Use epoch_size='replace' or a number of samples.",
        )
    return real * share / (1 - share)


def synthetic_before(mixture: Mixture, epoch: int) -> Fraction:
    """How many synthetic samples all epochs before this one should give together, before rounding."""
    same_from = settled(mixture.ratio)
    changing = epoch if same_from is None else min(epoch, same_from)
    sums = mixture._sums
    for earlier in range(len(sums) - 1, changing):
        sums[earlier + 1] = sums[earlier] + exact_synthetic(mixture, earlier)
    total = sums[changing]
    return total if epoch == changing else total + (epoch - changing) * exact_synthetic(mixture, changing)


def running_counts(mixture: Mixture, epoch: int) -> tuple[int, ...]:
    """How many samples of each source all epochs before this one give together, real sources first."""
    synthetic, size = ceil(synthetic_before(mixture, epoch)), mixture.epoch_size
    if size == "add":
        reals = tuple(epoch * (part.length or 0) for part in mixture.real)
    else:
        total = epoch * (mixture.real_length if size == "replace" else int(size))
        reals = split(mixture.real_weights, total - synthetic)
    return reals + split(mixture.synthetic_weights, synthetic)


def quotas(mixture: Mixture, epoch: int) -> tuple[int, ...]:
    """How many samples of each source an epoch gives, real sources first; their sum is its length.

    Raises:
        ConfigError: where the ratio cannot be kept with these sources.
        DataError: where there are no real scans to keep it.
    """
    exact_synthetic(mixture, epoch)  # raises where the schedule has no such epoch
    before, after = running_counts(mixture, epoch), running_counts(mixture, epoch + 1)
    return tuple(b - a for a, b in zip(before, after, strict=True))


@dataclass(frozen=True)
class _Node:
    """``round(m * p / q)`` of the first m samples go left, the others right; a leaf is the number of a source."""

    p: int
    q: int
    left: "_Node | int"
    right: "_Node | int"


Number = TypeVar("Number", int, NDArray[np.int64])


def split(weights: Sequence[Fraction], total: int) -> tuple[int, ...]:
    """How many of the first ``total`` samples each source gets.

    Their sum is ``total``, none falls when ``total`` rises, and with up to four sources each is within one of its exact
    share (a leaf at depth 2 is off by less than 1/2 + 1/2); with n sources, within ``log2(n) / 2`` rounded up.
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


def deal(weights: Sequence[Fraction], samples: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The source of each sample, and how many that source got before it; ``split`` counts the same.

    Args:
        weights: of the sources.
        samples: (N,) numbers of samples, from 0.

    Returns:
        (N,) sources, (N,) numbers within them.
    """
    sources, numbers = np.empty_like(samples), np.empty_like(samples)

    def walk(node: _Node | int, where: NDArray[np.intp], given: NDArray[np.int64]) -> None:
        if isinstance(node, int):
            sources[where], numbers[where] = node, given
        else:
            left = _left(node, given)
            goes_left = _left(node, given + 1) > left
            walk(node.left, where[goes_left], left[goes_left])
            walk(node.right, where[~goes_left], (given - left)[~goes_left])

    walk(_tree(tuple(weights)), np.arange(len(samples)), samples)
    return sources, numbers


def _left(node: _Node, count: Number) -> Number:
    """``round(count * p / q)``, halves up."""
    whole, rest = count // node.q, count % node.q
    return whole * node.p + (2 * rest * node.p + node.q) // (2 * node.q)


def _most(node: _Node | int, count: int) -> tuple[int, ...]:
    """The most that each source, in order, can get of so many samples in a row."""
    found: dict[int, int] = {}

    def walk(node: _Node | int, count: int) -> None:
        if isinstance(node, int):
            found[node] = count
        else:
            walk(node.left, ceil(Fraction(count * node.p, node.q)))
            walk(node.right, ceil(Fraction(count * (node.q - node.p), node.q)))

    walk(node, count)
    return tuple(count for _, count in sorted(found.items()))


@lru_cache(256)
def _tree(weights: tuple[Fraction, ...]) -> _Node | int:
    """A tree of halves, the heaviest sources first, so that they stand where there are fewer roundings."""

    def grow(sources: Sequence[int]) -> _Node | int:
        if len(sources) == 1:
            return sources[0]
        left, right = sources[: len(sources) // 2], sources[len(sources) // 2 :]
        share = sum((weights[i] for i in left), Fraction(0)) / sum(weights[i] for i in sources)
        p, q = share.limit_denominator(_FINEST).as_integer_ratio()
        return _Node(p, q, grow(left), grow(right))

    return grow(sorted(range(len(weights)), key=lambda i: -weights[i]))


def _exact(value: Any) -> Fraction:
    """0.1 is one tenth, not the float beside it."""
    return Fraction(repr(float(value)))
