"""The plan of an epoch: which sample is at which position, as a pure function of the mixture and
the epoch.

The sample at a position is computed from the position alone. A plan of any length therefore takes
the same memory, and workers, ranks, batch size and resumption cannot change it.

A permutation keyed by (seed, epoch) maps a position to a *rank*; the ranks are divided among the
sources in order, by their quotas (quotas.py). Within its source, a sample has a running number that
counts over all epochs. Real sources are permuted again each time they are exhausted: after any
number of epochs, the numbers of uses of two real scans differ by at most one. Synthetic scans are
numbered upwards, so that each is new. With ``reuse = k`` they come in laps whose length is the
largest number that an epoch takes; every lap comes k times, in k epochs, before the next lap
begins.
"""

import hashlib
import json
from dataclasses import dataclass
from functools import cached_property
from math import ceil, floor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.geometry.arrays import Int64Array
from lidar_synth.mixing.permutation import permute, permute_blocks
from lidar_synth.mixing.quotas import (
    Mixture,
    PlannedSource,
    count_before,
    count_samples,
    deal,
    synthetic_before,
)
from lidar_synth.mixing.schedules import share_of

VERSION = "lidar-synth-plan/2"
"""Part of every plan's hash; changes when the same mixture gives another order."""

# streams of the permutations; each source has its own
_ORDER, _REALS, _SOURCES = range(3)
_BLOCK = 256  # number of positions computed together, as most are accessed in order
_BLOCKS = 8  # number of blocks in the cache


@dataclass(frozen=True)
class MixingPlan:
    """The samples at the N positions of an epoch.

    ``plan[position]`` is the number of the source (real sources in order, then synthetic ones) and
    the local index within it. ``plan.at(positions)`` returns both for many positions at once.

    Args:
        mixture: the sources and the settings.
        epoch: 0 <= epoch < 2^40.

    Raises:
        ConfigError: on an epoch without a ratio, or with one that the sources cannot serve.
    """

    mixture: Mixture
    epoch: int

    def __post_init__(self) -> None:
        self.counts  # noqa: B018 - raises where the epoch cannot be planned

    @cached_property
    def counts(self) -> tuple[int, ...]:
        """Number of samples from each source."""
        return count_samples(self.mixture, self.epoch)

    @cached_property
    def before(self) -> tuple[int, ...]:
        """Number of samples from each source in all earlier epochs together."""
        return count_before(self.mixture, self.epoch)

    @property
    def reals(self) -> int:
        """Number of real sources."""
        return len(self.mixture.real)

    @property
    def synthetics(self) -> int:
        """Number of synthetic samples."""
        return sum(self.counts[self.reals :])

    def __len__(self) -> int:
        return self.mixture.length

    def __getitem__(self, position: int) -> tuple[int, int]:
        """The source and the local index of the sample at a position.

        Raises:
            IndexError: if the epoch has no such position.
        """
        if not 0 <= position < len(self):
            raise IndexError(f"position {position} of {len(self)}")
        block, offset = divmod(int(position), _BLOCK)
        if (entries := self._cache.get(block)) is None:
            entries = self.at(
                np.arange(block * _BLOCK, min((block + 1) * _BLOCK, len(self)))
            )
            if len(self._cache) >= _BLOCKS:
                self._cache.clear()
            self._cache[block] = entries
        return int(entries[0][offset]), int(entries[1][offset])

    def at(self, positions: Int64Array) -> tuple[Int64Array, Int64Array]:
        """The sources and local indices, (N,) each, of (N,) positions, 0 <= position < length."""
        rank = (
            self._balanced(positions)
            if self.mixture.balanced
            else self._shuffled(positions)
        )
        source = np.searchsorted(np.cumsum(self.counts), rank, side="right")
        number = (np.array(self.before, np.int64) - self._starts)[source] + rank
        index = np.empty_like(number)
        for each in np.unique(source).tolist():
            here = source == each
            index[here] = self._local(each, number[here])
        return source, index

    @property
    def source(self) -> Int64Array:
        """(N,) the source at every position, computed on access."""
        return self.at(np.arange(len(self)))[0]

    @property
    def index(self) -> Int64Array:
        """(N,) the local index at every position, computed on access."""
        return self.at(np.arange(len(self)))[1]

    @property
    def domain(self) -> NDArray[np.bool_]:
        """(N,) True at the positions of synthetic samples, computed on access."""
        synthetic: NDArray[np.bool_] = self.source >= self.reals
        return synthetic

    @cached_property
    def facts(self) -> dict[str, Any]:
        """Everything that determines the plan, in JSON types."""
        mixture = self.mixture
        return {
            "order": VERSION,
            "seed": mixture.seed,
            "epoch": self.epoch,
            "ratio": str(share_of(mixture.ratio, self.epoch)),
            "epoch_size": mixture.epoch_size,
            "reuse": mixture.reuse,
            "balanced": mixture.balanced,
            "real": [_facts_of(source) for source in mixture.real],
            "synthetic": [_facts_of(source) for source in mixture.synthetic],
            "samples": list(self.counts),
            "samples before": list(self.before),
            "synthetic before": str(synthetic_before(mixture, self.epoch)),
            "laps": list(mixture.laps) if mixture.reuse > 1 else [],
        }

    @cached_property
    def hash(self) -> str:
        """SHA-256 of ``facts``, as hexadecimal digits."""
        return hashlib.sha256(
            json.dumps(self.facts, sort_keys=True).encode()
        ).hexdigest()

    @cached_property
    def _starts(self) -> Int64Array:
        """The first rank of each source."""
        starts: Int64Array = np.cumsum((0, *self.counts[:-1]), dtype=np.int64)
        return starts

    @cached_property
    def _cache(self) -> dict[int, tuple[Int64Array, Int64Array]]:
        return {}

    def _shuffled(self, positions: Int64Array) -> Int64Array:
        return permute(positions, len(self), self.mixture.seed, _ORDER, self.epoch)

    def _balanced(self, positions: Int64Array) -> Int64Array:
        """Ranks with synthetic samples spread evenly over the epoch, and synthetic sources among
        them."""
        before = self._synthetic_up_to(positions)
        after = self._synthetic_up_to(positions + 1)
        synthetic = after > before
        rank = np.empty(len(positions), np.int64)
        real = (positions - before)[~synthetic]
        key = (self.mixture.seed, _REALS, self.epoch)
        rank[~synthetic] = permute(real, len(self) - self.synthetics, *key)
        if synthetic.any():
            rank[synthetic] = self._deal(before[synthetic])
        return rank

    def _deal(self, before: Int64Array) -> Int64Array:
        """Ranks of synthetic samples, from the number of those before each in the epoch."""
        earlier = sum(self.before[self.reals :])
        source, number = deal(self.mixture.synthetic_weights, before + earlier)
        source += self.reals
        rank = np.empty(len(source), np.int64)
        for each, start in enumerate(self._starts.tolist()[self.reals :], self.reals):
            here = source == each
            within = number[here] - self.before[each]
            rank[here] = start + self._ordered(each, within)
        return rank

    def _ordered(self, source: int, numbers: Int64Array) -> Int64Array:
        """The places in the epoch's order of a synthetic source's samples, numbered within the
        epoch; blocks begin at multiples of their size."""
        count = self.counts[source]
        key = (self.mixture.seed, _SOURCES + source, self.epoch)
        block = self.mixture.synthetic[source - self.reals].block
        if block == 1:
            return permute(numbers, count, *key)
        first = self._local(source, np.array([self.before[source]]))
        return (
            permute_blocks(numbers, count, block, *key) + int(-first[0]) % block
        ) % count

    def _synthetic_up_to(self, positions: Int64Array) -> Int64Array:
        """Number of synthetic samples among the first ``positions`` of the epoch: the exact number,
        rounded up.

        The exact number counts from the first epoch on, so that at the end of an epoch the result
        equals its quota.
        """
        p, q = share_of(self.mixture.ratio, self.epoch).as_integer_ratio()
        exact = synthetic_before(self.mixture, self.epoch)
        # Surplus from rounding up so far, in units of 1 / q.
        ahead = floor((ceil(exact) - exact) * q)
        return -((ahead - positions * p) // q)

    def _local(self, source: int, number: Int64Array) -> Int64Array:
        """The local indices of a source's running numbers."""
        mixture = self.mixture
        if source < self.reals:
            length = mixture.real[source].length or 0
            return permute(
                number % length,
                length,
                mixture.seed,
                _SOURCES + source,
                number // length,
            )
        planned = mixture.synthetic[source - self.reals]
        if mixture.reuse > 1:
            lap = mixture.laps[source - self.reals]
            number = number // (mixture.reuse * lap) * lap + number % lap
        return number if planned.length is None else number % planned.length


def _facts_of(source: PlannedSource) -> dict[str, Any]:
    facts = {
        "length": source.length,
        "weight": source.weight,
        "identity": source.identity,
    }
    return facts if source.block == 1 else facts | {"block": source.block}
