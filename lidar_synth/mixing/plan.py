"""Which sample stands where: the plan of an epoch as a pure function of the mixture and the epoch.

Nothing is drawn at random along the way and nothing is stored: what stands at a position is computed from the position,
so that a plan of any length takes the same memory, and workers, ranks, batch size and resumption cannot change it.

A position leads to a *rank* by an order keyed by (seed, epoch); ranks are divided among the sources in turn, by their
quotas (quotas.py). Within its source, a sample's running number counts over all epochs. Real scans follow one another
through endless permutations of their source: after any number of epochs each was given equally often, up to one.
Synthetic scans are counted up, so that they are fresh. With ``reuse = k`` they come in laps, as long as an epoch at its
most, and every lap is given k times before the next: the k times fall into k epochs.
"""

import hashlib
import json
from dataclasses import dataclass
from functools import cached_property
from math import ceil, floor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.mixing.permutation import permute
from lidar_synth.mixing.quotas import Mixture, PlannedSource, deal, quotas, running_counts, synthetic_before
from lidar_synth.mixing.schedules import share_of

VERSION = "lidar-synth-plan/2"
"""PlannedSource of every plan's hash; changes when the same mixture gives another order."""

_ORDER, _REALS, _SOURCES = range(3)  # streams of the permutations; each source has one of its own
_BLOCK = 256  # positions that are computed together: most are asked for one after another
_BLOCKS = 8  # blocks that are kept


@dataclass(frozen=True)
class MixingPlan:
    """An epoch: what stands at each of its N positions.

    ``plan[position]`` is the number of the source (the real ones in order, then the synthetic ones) and the local index
    in it. ``plan.at(positions)`` gives both for many at once.

    Args:
        mixture: of sources.
        epoch: 0 <= epoch < 2^40.

    Raises:
        ConfigError: on an epoch for which there is no ratio, or none that the sources can serve.
    """

    mixture: Mixture
    epoch: int

    def __post_init__(self) -> None:
        self.counts  # noqa: B018 - raises where the epoch cannot be planned

    @cached_property
    def counts(self) -> tuple[int, ...]:
        """Samples of each source."""
        return quotas(self.mixture, self.epoch)

    @cached_property
    def before(self) -> tuple[int, ...]:
        """Samples of each source in all earlier epochs together."""
        return running_counts(self.mixture, self.epoch)

    @property
    def reals(self) -> int:
        """How many real sources there are."""
        return len(self.mixture.real)

    @property
    def synthetics(self) -> int:
        """How many samples are synthetic."""
        return sum(self.counts[self.reals :])

    def __len__(self) -> int:
        return self._total

    def __getitem__(self, position: int) -> tuple[int, int]:
        """Source and local index.

        Raises:
            IndexError: where the epoch has no such position.
        """
        if not 0 <= position < len(self):
            raise IndexError(f"position {position} of {len(self)}")
        block, offset = divmod(int(position), _BLOCK)
        if (found := self._kept.get(block)) is None:
            found = self.at(np.arange(block * _BLOCK, min((block + 1) * _BLOCK, len(self))))
            if len(self._kept) >= _BLOCKS:
                self._kept.clear()
            self._kept[block] = found
        return int(found[0][offset]), int(found[1][offset])

    def at(self, positions: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Sources and local indices of (N,) positions, 0 <= position < length; (N,) each."""
        rank = self._balanced(positions) if self.mixture.balanced else self._shuffled(positions)
        source = np.searchsorted(np.cumsum(self.counts), rank, side="right")
        number = (np.array(self.before, np.int64) - self._starts)[source] + rank
        index = np.empty_like(number)
        for each in np.unique(source).tolist():
            here = source == each
            index[here] = self._local(each, number[here])
        return source, index

    @property
    def source(self) -> NDArray[np.int64]:
        """(N,) the source of every position; this and the next two are computed when they are asked for."""
        return self.at(np.arange(len(self)))[0]

    @property
    def index(self) -> NDArray[np.int64]:
        """(N,) the local index of every position."""
        return self.at(np.arange(len(self)))[1]

    @property
    def domain(self) -> NDArray[np.bool_]:
        """(N,) where a synthetic sample stands."""
        synthetic: NDArray[np.bool_] = self.source >= self.reals
        return synthetic

    @cached_property
    def facts(self) -> dict[str, Any]:
        """All that the plan follows from, in values that JSON knows."""
        mixture = self.mixture
        return {
            "order": VERSION,
            "seed": mixture.seed,
            "epoch": self.epoch,
            "ratio": str(share_of(mixture.ratio, self.epoch)),
            "epoch_size": mixture.epoch_size,
            "reuse": mixture.reuse,
            "balanced": mixture.balanced,
            "real": [_facts_of(part) for part in mixture.real],
            "synthetic": [_facts_of(part) for part in mixture.synthetic],
            "samples": list(self.counts),
            "samples before": list(self.before),
            "synthetic before": str(synthetic_before(mixture, self.epoch)),
            "laps": list(mixture.laps) if mixture.reuse > 1 else [],
        }

    @cached_property
    def hash(self) -> str:
        """sha256 of ``facts``, in hexadecimal."""
        return hashlib.sha256(json.dumps(self.facts, sort_keys=True).encode()).hexdigest()

    @cached_property
    def _total(self) -> int:
        return sum(self.counts)

    @cached_property
    def _starts(self) -> NDArray[np.int64]:
        """The first rank of each source."""
        starts: NDArray[np.int64] = np.cumsum((0, *self.counts[:-1]), dtype=np.int64)
        return starts

    @cached_property
    def _kept(self) -> dict[int, tuple[NDArray[np.int64], NDArray[np.int64]]]:
        return {}

    def _shuffled(self, positions: NDArray[np.int64]) -> NDArray[np.int64]:
        return permute(positions, len(self), self.mixture.seed, _ORDER, self.epoch)

    def _balanced(self, positions: NDArray[np.int64]) -> NDArray[np.int64]:
        """Ranks where synthetic samples are spread evenly, and the sources among them."""
        before, after = self._synthetic_up_to(positions), self._synthetic_up_to(positions + 1)
        synthetic, seed = after > before, self.mixture.seed
        rank = np.empty(len(positions), np.int64)
        real = (positions - before)[~synthetic]
        rank[~synthetic] = permute(real, len(self) - self.synthetics, seed, _REALS, self.epoch)
        if synthetic.any():
            earlier = sum(self.before[self.reals :])
            source, number = deal(self.mixture.synthetic_weights, before[synthetic] + earlier)
            dealt = np.empty(len(source), np.int64)
            for each, start in enumerate(self._starts.tolist()[self.reals :]):
                here, total = source == each, self.reals + each
                own = number[here] - self.before[total]
                dealt[here] = start + permute(own, self.counts[total], seed, _SOURCES + total, self.epoch)
            rank[synthetic] = dealt
        return rank

    def _synthetic_up_to(self, positions: NDArray[np.int64]) -> NDArray[np.int64]:
        """How many of the first samples of the epoch are synthetic: the exact number over all epochs, rounded up.

        At the epoch's end this is its quota: where n synthetic samples were asked for and n + d given, the exact
        number there is between those at the epoch's beginning and end, each rounded up with less than 1 to spare.
        """
        p, q = share_of(self.mixture.ratio, self.epoch).as_integer_ratio()
        exact = synthetic_before(self.mixture, self.epoch)
        ahead = floor((ceil(exact) - exact) * q)  # what was rounded up so far, in units of 1 / q
        return -((ahead - positions * p) // q)

    def _local(self, source: int, number: NDArray[np.int64]) -> NDArray[np.int64]:
        """The scans of a source's running numbers."""
        mixture = self.mixture
        if source < self.reals:
            length = mixture.real[source].length or 0
            return permute(number % length, length, mixture.seed, _SOURCES + source, number // length)
        part = mixture.synthetic[source - self.reals]
        if mixture.reuse > 1:
            lap = mixture.laps[source - self.reals]
            number = number // (mixture.reuse * lap) * lap + number % lap
        return number if part.length is None else number % part.length


def plan(mixture: Mixture, epoch: int) -> MixingPlan:
    """The plan of an epoch; see ``MixingPlan``."""
    return MixingPlan(mixture, epoch)


def _facts_of(part: PlannedSource) -> dict[str, Any]:
    return {"length": part.length, "weight": part.weight, "identity": part.identity}
