"""The plan: exact counts, running indices, and an order that depends on seed and epoch alone."""

import tracemalloc
from collections import Counter
from dataclasses import replace
from fractions import Fraction
from math import ceil

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.mixing import (
    Linear,
    MixingPlan,
    Mixture,
    PlannedSource,
    make_schedule,
)
from lidar_synth.mixing.batches import cut_steps, rank_share
from lidar_synth.mixing.permutation import TOGETHER
from lidar_synth.mixing.quotas import (
    count_before,
    count_samples,
    deal,
    exact_synthetic,
    split,
)
from lidar_synth.mixing.schedules import Schedule, share_of

ENDLESS = PlannedSource(None, identity="model")
OTHER = PlannedSource(None, identity="other")
THREE = PlannedSource(3)
WEIGHED = PlannedSource(3, 1.0)


def mixture(real: int = 6, ratio: object = 0.25, **options: object) -> Mixture:
    return Mixture(
        (PlannedSource(real, identity="real"),),
        (ENDLESS,),
        make_schedule(ratio),
        **options,
    )  # type: ignore[arg-type]


def rows(made: MixingPlan) -> list[str]:
    """``r3`` or ``s0`` for one source of each kind."""
    return [
        f"{'rs'[source]}{index}"
        for source, index in zip(made.source, made.index, strict=True)
    ]


def test_the_order_is_the_same_in_all_versions() -> None:
    """Literally: a run that is resumed with a later version has to find the rest of its epoch."""
    assert [rows(MixingPlan(mixture(), epoch)) for epoch in range(3)] == [
        ["r1", "r5", "r2", "r3", "s0", "s1", "r4", "r0"],
        ["r2", "r4", "r0", "s3", "r1", "r5", "r3", "s2"],
        ["r0", "r4", "r3", "r5", "r2", "s4", "r1", "s5"],
    ]
    assert (
        MixingPlan(mixture(), 2).hash
        == "da107b92653538fe9b6b1d5962019e9f6b0890443e66a738e8a9f71af8485751"
    )
    assert rows(MixingPlan(mixture(balanced=True), 0)) == [
        "s1",
        "r5",
        "r3",
        "r2",
        "s0",
        "r1",
        "r0",
        "r4",
    ]
    two = Mixture(
        (PlannedSource(3), PlannedSource(2)),
        (PlannedSource(None), PlannedSource(4)),
        make_schedule(0.5),
        seed=7,
        epoch_size="replace",
    )
    made = MixingPlan(two, 1)
    assert list(zip(made.source.tolist(), made.index.tolist(), strict=True)) == [
        (2, 2),
        (1, 1),
        (0, 2),
        (3, 1),
        (0, 1),
    ]
    weighted = replace(
        mixture(ratio=0.5, balanced=True, seed=7),
        synthetic=tuple(PlannedSource(None, w) for w in (1.0, 2.0, 3.0)),
    )
    order = zip(*MixingPlan(weighted, 0).at(np.arange(12)), strict=True)
    assert " ".join(f"{'rabc'[source]}{index}" for source, index in order) == (
        "c1 r5 b0 r0 c0 r4 a0 r3 c2 r2 b1 r1"
    )
    alike = replace(mixture(ratio=0.2, balanced=True), real=(PlannedSource(4),) * 2)
    orders = (zip(*MixingPlan(alike, n).at(np.arange(10)), strict=True) for n in (0, 1))
    assert [" ".join(f"{'abs'[s]}{i}" for s, i in order) for order in orders] == [
        "s0 a2 b0 b1 a3 s1 a1 a0 b3 b2",
        "s2 b3 b0 b2 a2 s3 b1 a0 a3 a1",
    ]


@settings(max_examples=60)
@given(
    real=st.integers(1, 40),
    hundredths=st.integers(0, 100),
    seed=st.integers(0, 2**64 - 1),
    epoch=st.integers(0, 10**6),
    size=st.sampled_from(["add", "replace", 1, 7, 50]),
    balanced=st.booleans(),
)
def test_counts_are_exact_over_epochs(
    real: int, hundredths: int, seed: int, epoch: int, size: str | int, balanced: bool
) -> None:
    share = Fraction(hundredths, 100)
    assume(share < 1 or size != "add")
    mixed = mixture(
        real, hundredths / 100, seed=seed, epoch_size=size, balanced=balanced
    )
    made = MixingPlan(mixed, epoch)
    assert (int(made.domain.sum()), len(made)) == (made.synthetics, sum(made.counts))
    if size == "add":
        assert sorted(made.index[~made.domain]) == list(range(real))
        exact = Fraction(ceil(real * share / (1 - share)))
    else:
        assert len(made) == (real if size == "replace" else size)
        exact = len(made) * share
    assert abs(made.synthetics - exact) < 1
    assert sum(count_before(mixed, epoch)[1:]) == ceil(epoch * exact)


WEIGHTS = st.lists(st.sampled_from([None, 1, 9, 2.5, 100]), min_size=1, max_size=4)


@settings(max_examples=40)
@given(
    WEIGHTS,
    WEIGHTS,
    st.sampled_from([0.01, 0.1, 0.25, 1 / 3, 0.5, 0.8]),
    st.sampled_from(["replace", 3, 40]),
    st.booleans(),
)
def test_every_source_gets_its_share_over_epochs(
    real: list[float | None],
    synthetic: list[float | None],
    ratio: float,
    size: str | int,
    balanced: bool,
) -> None:
    """After any number of epochs, to within one sample; what a plan gives is what is counted."""
    parts = (
        tuple(PlannedSource(3 + i, w) for i, w in enumerate(real)),
        tuple(PlannedSource(None, w) for w in synthetic),
    )
    schedule = make_schedule(ratio)
    mixed = Mixture(*parts, schedule, epoch_size=size, balanced=balanced)  # type: ignore[arg-type]
    given_so_far = np.zeros(len(real + synthetic), int)
    exact = Fraction(0)
    for epoch in range(12):
        made = MixingPlan(mixed, epoch)
        assert np.bincount(made.source, minlength=len(given_so_far)).tolist() == list(
            made.counts
        )
        given_so_far += made.counts
        exact += exact_synthetic(mixed, epoch)
        kinds = (
            (mixed.real_weights, given_so_far[: len(real)]),
            (mixed.synthetic_weights, given_so_far[len(real) :]),
        )
        assert abs(sum(kinds[1][1]) - exact) < 1
        for weights, counts in kinds:
            for weight, count in zip(weights, counts, strict=True):
                assert abs(count - sum(counts) * weight / sum(weights)) < 1


def test_rare_sources_and_small_ratios_get_their_turn() -> None:
    mixed = Mixture(
        (PlannedSource(4),),
        (PlannedSource(None, 9.0), PlannedSource(None, 1.0)),
        make_schedule(0.5),
    )
    assert count_before(mixed, 50) == (200, 180, 20)
    turns = [
        count_samples(mixture(4, 0.1, epoch_size="replace"), epoch)
        for epoch in range(5)
    ]
    assert turns == [(3, 1), (4, 0), (3, 1), (4, 0), (4, 0)]
    assert count_before(mixture(4, 0.1, epoch_size="replace"), 900) == (3240, 360)


@pytest.mark.parametrize("size", ["add", "replace", 17])
@pytest.mark.parametrize(
    "ratio",
    [0.1, 0.25, 1 / 3, Linear(0, 0.6, 4), {0: 0.6, 5: 0.2}, lambda e: 0.5 / (e + 1)],
)
def test_all_epochs_have_one_length(ratio: object, size: str | int) -> None:
    """What wraps a dataset asks for its length once."""
    for real in range(1, 30):
        mixed = mixture(real, ratio, epoch_size=size)
        for epoch in range(8):
            counts = count_samples(mixed, epoch)
            share = share_of(mixed.ratio, epoch)
            assert sum(counts) == mixed.length
            assert abs(counts[1] - mixed.length * share) < 1
            assert size != "add" or counts[0] >= real


LATE = {0: 0.1, 110: 0.8, 120: 0.1}


@pytest.mark.parametrize("ratio", [LATE, [0.1] * 110 + [0.8] * 10 + [0.1]])
def test_a_late_change_of_the_ratio_counts(ratio: object) -> None:
    late = mixture(20, ratio, reuse=2)
    assert count_samples(late, 112) == (20, 80)
    assert late.laps == (80,)


@settings(max_examples=60)
@given(
    st.lists(st.fractions("1/20", 50, max_denominator=20), min_size=1, max_size=9),
    st.integers(0, 10**12),
)
def test_samples_are_dealt_one_by_one(weights: list[Fraction], first: int) -> None:
    counts = [np.array(split(weights, first + i)) for i in range(20)]
    sources, numbers = deal(weights, np.arange(first, first + 19))
    for i, (source, number) in enumerate(zip(sources, numbers, strict=True)):
        assert counts[i].sum() == first + i
        assert number == counts[i][source]
        assert (counts[i + 1] - counts[i]).tolist() == [
            int(j == source) for j in range(len(weights))
        ]
    for i, count in enumerate(counts):
        for weight, own in zip(weights, count, strict=True):
            assert abs(int(own) - (first + i) * weight / sum(weights)) < (
                1 if len(weights) <= 4 else 2
            )


@settings(max_examples=30)
@given(
    st.integers(1, 7),
    st.sampled_from([0.1, 0.25, 1 / 3, 0.5, 0.8]),
    st.sampled_from(["add", "replace", 23]),
)
def test_running_indices(real: int, ratio: float, size: str | int) -> None:
    """Over the epochs, real scans are given equally often, up to one, and synthetic ones once each,
    in turn."""
    mixed = mixture(real, ratio, epoch_size=size)
    given_reals: Counter[int] = Counter(dict.fromkeys(range(real), 0))
    synthetic: list[int] = []
    for epoch in range(6):
        made = MixingPlan(mixed, epoch)
        given_reals.update(made.index[~made.domain].tolist())
        fresh = sorted(made.index[made.domain].tolist())
        assert fresh == list(range(len(synthetic), len(synthetic) + len(fresh)))
        synthetic += fresh
        assert max(given_reals.values()) - min(given_reals.values()) <= 1


@pytest.mark.slow
@settings(max_examples=40)
@given(
    st.integers(2, 5),
    st.integers(1, 30),
    st.sampled_from([0.1, 0.25, 1 / 3, 0.5]),
    WEIGHTS,
    st.booleans(),
    st.sampled_from([False, True]),
)
def test_reuse_is_spread_over_epochs(
    reuse: int,
    real: int,
    ratio: float,
    weights: list[float | None],
    balanced: bool,
    rising: bool,
) -> None:
    """No epoch has a scan twice, and in the long run each is given ``reuse`` times."""
    schedule = make_schedule(Linear(0.0, ratio, 3) if rising else ratio)
    sources = tuple(PlannedSource(None, w) for w in weights)
    mixed = Mixture(
        (PlannedSource(real),), sources, schedule, reuse=reuse, balanced=balanced
    )
    counts: Counter[tuple[int, int]] = Counter()
    for epoch in range(4 * reuse):
        made = MixingPlan(mixed, epoch)
        here = list(
            zip(
                made.source[made.domain].tolist(),
                made.index[made.domain].tolist(),
                strict=True,
            )
        )
        assert len(set(here)) == len(here)
        counts.update(here)
    assert max(counts.values(), default=0) <= reuse
    for source, lap in enumerate(mixed.laps, 1):
        whole = count_before(mixed, 4 * reuse)[source] // (reuse * lap) * lap
        assert all(counts[source, scan] == reuse for scan in range(whole))


@pytest.mark.parametrize("ratios", [[0.1, 0.5], [0.5, 0.1]])
def test_a_lap_is_as_long_as_the_largest_epoch(ratios: list[float]) -> None:
    mixed = mixture(10, ratios, reuse=2)
    assert mixed.laps == (10,)
    for epoch in range(2):
        made = MixingPlan(mixed, epoch)
        drawn = made.index[made.domain].tolist()
        assert len(set(drawn)) == len(drawn)


def test_a_bank_begins_again() -> None:
    bank = Mixture((PlannedSource(6),), (PlannedSource(4),), make_schedule(0.4))
    indices = [
        sorted(MixingPlan(bank, e).index[MixingPlan(bank, e).domain].tolist())
        for e in range(3)
    ]
    assert indices == [[0, 1, 2, 3]] * 3
    few = Mixture((PlannedSource(6),), (PlannedSource(4),), make_schedule(0.5), reuse=2)
    indices = [
        sorted(MixingPlan(few, e).index[MixingPlan(few, e).domain].tolist())
        for e in range(3)
    ]
    assert indices == [[0, 0, 1, 1, 2, 3], [0, 0, 1, 1, 2, 3], [0, 1, 2, 2, 3, 3]]


def test_weights_are_kept() -> None:
    assert split([Fraction(1), Fraction(1), Fraction(1)], 10) == (3, 4, 3)
    assert split([Fraction(5), Fraction(3), Fraction(1)], 9) == (5, 3, 1)
    assert split([], 0) == ()
    parts = (
        (PlannedSource(10, 1.0), PlannedSource(30, 3.0)),
        (PlannedSource(None, 1.0), PlannedSource(None, 2.0), PlannedSource(5, 1.0)),
    )
    weighted = Mixture(*parts, make_schedule(0.4), epoch_size=50)
    assert count_before(weighted, 4) == (30, 90, 20, 40, 20)
    unweighted = Mixture(
        (PlannedSource(10), PlannedSource(30)),
        (ENDLESS, PlannedSource(5)),
        make_schedule(0.4),
        epoch_size=50,
    )
    assert count_before(unweighted, 4) == (30, 90, 40, 40)


@settings(max_examples=60)
@given(
    st.integers(8, 200),
    st.fractions(0, 1, max_denominator=20),
    st.integers(1, 12),
    st.integers(0, 50),
    st.sampled_from(["add", "replace", "number"]),
)
def test_a_balanced_plan_is_exact_in_every_batch(
    total: int, share: Fraction, batch: int, epoch: int, size: str
) -> None:
    assume(share < 1 or size != "add")
    length = total if size == "number" else size
    domain = MixingPlan(
        mixture(total, float(share), epoch_size=length, balanced=True), epoch
    ).domain
    for start in range(len(domain) - batch + 1):
        difference = int(domain[start : start + batch].sum()) - batch * share
        assert abs(difference) < 1
        assert (batch * share).denominator > 1 or difference == 0


@settings(max_examples=40)
@given(
    st.lists(st.integers(1, 9), min_size=2, max_size=4),
    st.integers(1, 12),
    st.integers(0, 20),
)
def test_a_balanced_plan_spreads_several_synthetic_sources(
    weights: list[int], batch: int, epoch: int
) -> None:
    sources = tuple(PlannedSource(None, float(w)) for w in weights)
    mixed = Mixture(
        (PlannedSource(9),), sources, make_schedule(0.5), epoch_size=120, balanced=True
    )
    source = MixingPlan(mixed, epoch).source
    for start in range(120 - batch + 1):
        for number, weight in enumerate(weights, 1):
            given_here = int((source[start : start + batch] == number).sum())
            assert abs(given_here - Fraction(batch * weight, 2 * sum(weights))) < 2 + (
                len(weights) > 2
            )


def test_equal_synthetic_sources_alternate_in_every_batch() -> None:
    mixed = Mixture(
        (PlannedSource(40),), (ENDLESS, ENDLESS), make_schedule(0.5), balanced=True
    )
    batches = MixingPlan(mixed, 1).source.reshape(-1, 4)
    assert [np.bincount(batch, minlength=3).tolist() for batch in batches] == [
        [2, 1, 1]
    ] * 20


SCHEDULES: list[tuple[object, list[float]]] = [
    (0.25, [0.25] * 5),
    ([0.1, 0.2, 0.3, 0.4, 0.5], [0.1, 0.2, 0.3, 0.4, 0.5]),
    ({0: 0.5, 3: 0.25}, [0.5, 0.5, 0.5, 0.25, 0.25]),
    (Linear(0.0, 0.5, 3), [0.0, 0.25, 0.5, 0.5, 0.5]),
    (np.linspace(0.5, 0.1, 5), [0.5, 0.4, 0.3, 0.2, 0.1]),
    (torch.linspace(0.5, 0.1, 5), [0.5, 0.4, 0.3, 0.2, 0.1]),
    (lambda epoch: 1 / (epoch + 2), [1 / 2, 1 / 3, 1 / 4, 1 / 5, 1 / 6]),
]


@pytest.mark.parametrize(("ratio", "expected"), SCHEDULES)
def test_schedules(ratio: object, expected: list[float]) -> None:
    schedule: Schedule = make_schedule(ratio)  # type: ignore[arg-type]
    assert [float(share_of(schedule, epoch)) for epoch in range(5)] == pytest.approx(
        expected, abs=1e-6
    )
    mixed = mixture(7, ratio)
    before = (0, 0)
    for epoch in range(5):
        assert count_before(mixed, epoch) == before
        total = np.add(before, count_samples(mixed, epoch))
        before = tuple(total.tolist())  # type: ignore[assignment]
        assert before[1] == ceil(
            sum(exact_synthetic(mixed, earlier) for earlier in range(epoch + 1))
        )


def test_every_real_scan_stays_in_epochs_far_ahead() -> None:
    """A share that rises after the first hundred epochs decides the length of all of them."""
    mixed = mixture(10, {0: 0.2, 150: 0.5})
    assert count_samples(mixed, 150) == (10, 10) and mixed.length == 20
    assert count_before(mixture(10, 0.5), 10**9) == (10**10, 10**10)


def test_a_late_epoch_costs_no_more_than_the_first() -> None:
    calls: list[int] = []

    class Counted(Linear):
        def __call__(self, epoch: int) -> float:
            calls.append(epoch)
            return super().__call__(epoch)

    mixed = mixture(3, Counted(0.0, 0.5, 4))
    # 0, 1 and 2 synthetic samples of 6, then 3 in every epoch
    assert count_before(mixed, 10**9) == (15 + 3 * (10**9 - 3), 3 + 3 * (10**9 - 3))
    assert len(calls) < 20


def test_a_tenth_is_a_tenth() -> None:
    assert share_of(make_schedule(0.1), 0) == Fraction(1, 10)
    assert count_before(mixture(1, 0.1, epoch_size=5), 20) == (90, 10)


def test_the_hash_tells_plans_apart() -> None:
    one = MixingPlan(mixture(), 0).hash
    others = [
        MixingPlan(mixture(), 1),
        MixingPlan(mixture(seed=1), 0),
        MixingPlan(mixture(ratio=0.5), 0),
        MixingPlan(mixture(balanced=True), 0),
        MixingPlan(
            Mixture(
                (PlannedSource(6, identity="real"),), (OTHER,), make_schedule(0.25)
            ),
            0,
        ),
    ]
    assert one == MixingPlan(mixture(), 0).hash
    assert len({one, *(other.hash for other in others)}) == 6
    # The largest number of an epoch to come determines which scans are used again.
    growing = ({0: 0.25, 3: share} for share in (0.25, 0.5))
    same, longer = (
        MixingPlan(mixture(ratio=ratio, reuse=2, epoch_size=8), 2) for ratio in growing
    )
    assert same.counts == longer.counts and rows(same) != rows(longer)
    assert same.hash != longer.hash


@pytest.mark.parametrize("batch", [1, 2, 3])
@pytest.mark.parametrize("ranks", [1, 2, 3, 4])
def test_ranks_share_every_step_and_all_take_as_many(batch: int, ranks: int) -> None:
    for end in range(26):
        for start in range(end + 1):
            steps = cut_steps(start, end, batch, ranks)
            assert [i for step in steps for i in step] == list(range(start, end))
            for step in steps:
                shares = [rank_share(step, rank, ranks) for rank in range(ranks)]
                assert [i for share in shares for i in share] == list(step)
                assert max(map(len, shares)) - min(map(len, shares)) <= 1
                assert min(map(len, shares)) >= 1 or end - start < ranks
            whole = cut_steps(start, end, batch, ranks, drop_last=True)
            assert all(len(step) == batch * ranks for step in whole)
            assert end - (whole[-1].stop if whole else start) < batch * ranks


def test_the_remaining_samples_do_not_depend_on_the_number_of_ranks() -> None:
    for step in cut_steps(0, 23, 2, 3):
        for batch, ranks in ((1, 1), (4, 2), (2, 3), (3, 4)):
            rest = [i for s in cut_steps(step.stop, 23, batch, ranks) for i in s]
            assert rest == list(range(step.stop, 23))


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (
            lambda: mixture(ratio=1.2),
            ConfigError,
            r"ratio 1.2 in epoch 0; expected the share .* from 0 to 1",
        ),
        (lambda: mixture(ratio=-0.1), ConfigError, r"ratio -0.1"),
        (lambda: mixture(ratio=float("nan")), ConfigError, r"ratio nan"),
        (lambda: mixture(ratio="a quarter"), ConfigError, r"ratio 'a quarter'"),
        (lambda: mixture(ratio=[0.5, 2]), ConfigError, r"ratio 2 in epoch 1"),
        (lambda: mixture(ratio=[]), ConfigError, r"a ratio from epoch 0 on"),
        (lambda: mixture(ratio={1: 0.5}), ConfigError, r"a ratio from epoch 0 on"),
        (
            lambda: Linear(0.5, 0.1, epochs=20.0),  # type: ignore[arg-type]
            ConfigError,
            "epochs=20.0; expected an integer",
        ),
        (
            lambda: mixture(ratio=Linear(0, 0.5, 1)),
            ConfigError,
            r"over 1 epochs; expected at least 2",
        ),
        (
            lambda: MixingPlan(mixture(ratio=[0.5, 0.4]), 2),
            ConfigError,
            r"epoch 2 of a ratio schedule for 2 epochs.*longer",
        ),
        (
            lambda: MixingPlan(mixture(ratio=lambda e: e * 0.6), 2),
            ConfigError,
            r"ratio 1.2 in epoch 2",
        ),
        (lambda: MixingPlan(mixture(), -1), ConfigError, r"epoch -1"),
        (
            lambda: mixture(ratio=1.0),
            ConfigError,
            r"ratio 1 .*epoch_size='add'.*Use epoch_size='replace' or",
        ),
        (
            lambda: mixture(epoch_size="double"),
            ConfigError,
            r"epoch_size='double'; expected 'add', 'replace' or",
        ),
        (
            lambda: mixture(ratio=LATE | {110: 1.0}),
            ConfigError,
            r"ratio 1 in epoch 110 .*epoch_size='add'",
        ),
        (lambda: mixture(epoch_size=0), ConfigError, r"epoch_size=0"),
        (lambda: mixture(reuse=0), ConfigError, r"reuse 0"),
        (lambda: mixture(reuse=1.5), ConfigError, r"reuse 1\.5; expected a whole"),
        (lambda: mixture(seed=-1), ConfigError, r"seed -1"),
        (lambda: mixture(real=0), DataError, r"a source without scans"),
        (
            lambda: Mixture((), (ENDLESS,), make_schedule(0.5), epoch_size=4),
            DataError,
            r"no real scans.*ratio=1",
        ),
        (
            lambda: Mixture((), (ENDLESS,), make_schedule(1.0)),
            DataError,
            r"no real scans.*set epoch_size",
        ),
        (
            lambda: Mixture((THREE,), (), make_schedule(0.5)),
            ConfigError,
            r"ratio 0.5 .* without a synthetic source",
        ),
        (
            lambda: Mixture((WEIGHED,), (ENDLESS,), make_schedule(0.5)),
            ConfigError,
            r"weights of real sources",
        ),
        (
            lambda: Mixture((THREE,), (PlannedSource(3, 0.0),), make_schedule(0.5)),
            ConfigError,
            r"weight 0.0",
        ),
    ],
)
def test_invalid_plans_are_refused(
    make: object, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        make()  # type: ignore[operator]


def test_synthetic_only_and_real_only() -> None:
    only = Mixture((), (ENDLESS,), make_schedule(1), epoch_size=5)
    assert sorted(MixingPlan(only, 1).index.tolist()) == [5, 6, 7, 8, 9]
    assert (
        MixingPlan(
            Mixture((PlannedSource(4),), (), make_schedule(0)), 0
        ).domain.tolist()
        == [False] * 4
    )


@pytest.mark.slow
def test_a_plan_of_any_length_takes_the_same_memory() -> None:
    tracemalloc.start()
    try:
        for balanced in (False, True):
            mixed = Mixture(
                (PlannedSource(10**8),),
                (ENDLESS, ENDLESS),
                make_schedule(0.25),
                reuse=2,
                epoch_size=10**8,
                balanced=balanced,
            )
            made = MixingPlan(mixed, 3)
            asked = np.random.default_rng(0).integers(0, len(made), 200)
            found = [made[int(position)] for position in asked]
            assert found == list(
                zip(*(x.tolist() for x in made.at(asked)), strict=True)
            )
            assert len(made.hash) == 64
        assert tracemalloc.get_traced_memory()[1] < 2**20
    finally:
        tracemalloc.stop()


# Plans that go through a bank shard by shard


@pytest.mark.parametrize("reuse", [1, 2])
@pytest.mark.parametrize("block", [8, 16])
def test_a_plan_of_blocks_keeps_the_quotas_and_stays_in_few_blocks(
    reuse: int, block: int
) -> None:
    """Two banks of 480 scans with a quarter and a half of the samples; epochs of 500."""
    sources = tuple(PlannedSource(480, w, str(w), block) for w in (1.0, 2.0))
    plain = tuple(replace(source, block=1) for source in sources)
    mixtures = [
        Mixture(
            (PlannedSource(100),),
            synthetic,
            make_schedule(0.75),
            epoch_size=500,
            reuse=reuse,
            balanced=True,
        )
        for synthetic in (sources, plain)
    ]
    for epoch in range(6):
        plan, other = (MixingPlan(mixture, epoch) for mixture in mixtures)
        assert np.array_equal(plan.source, other.source)
        for source in (1, 2):
            here = plan.index[plan.source == source]
            assert sorted(here) == sorted(other.index[other.source == source])
            assert not np.array_equal(here, np.sort(here))
            # At most so many blocks are in use at a time, and those that the epoch cuts.
            used = here // block
            first = {b: np.flatnonzero(used == b)[0] for b in used.tolist()}
            last = {b: np.flatnonzero(used == b)[-1] for b in used.tolist()}
            whole = [b for b in first if np.count_nonzero(used == b) == block]
            for at in range(len(here)):
                assert sum(first[b] <= at <= last[b] for b in whole) <= TOGETHER


def test_blocks_change_the_hash_of_a_plan() -> None:
    def hash_of(block: int) -> str:
        bank = PlannedSource(48, identity="bank", block=block)
        return MixingPlan(
            Mixture((), (bank,), make_schedule(1.0), balanced=True, epoch_size=9), 0
        ).hash

    assert len({hash_of(1), hash_of(2), hash_of(3)}) == 3
