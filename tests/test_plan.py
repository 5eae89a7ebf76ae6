"""The plan: exact counts, running indices, and an order that depends on seed and epoch alone."""

from collections import Counter
from fractions import Fraction
from math import floor

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import assume, given, settings

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.mixing import Linear, Mixture, Part, Plan, make_schedule, plan
from lidar_synth.mixing.batches import cut_steps, rank_share
from lidar_synth.mixing.plan import largest_remainders, quotas, running_counts
from lidar_synth.mixing.schedules import Schedule, share_of

ENDLESS = Part(None, identity="model")


def mixture(real: int = 6, ratio: object = 0.25, **options: object) -> Mixture:
    return Mixture((Part(real, identity="real"),), (ENDLESS,), make_schedule(ratio), **options)  # type: ignore[arg-type]


def rows(made: Plan) -> list[str]:
    """``r3`` or ``s0`` for one source of each kind."""
    return [f"{'rs'[source]}{index}" for source, index in zip(made.source, made.index, strict=True)]


def test_the_order_is_what_it_always_was() -> None:
    """Literally: a run that is resumed with a later version has to find the rest of its epoch."""
    assert [rows(plan(mixture(), epoch)) for epoch in range(3)] == [
        ["s1", "s0", "r3", "r1", "r0", "r2", "r4", "r5"],
        ["r3", "r5", "s3", "r0", "r2", "r4", "s2", "r1"],
        ["r5", "r1", "s5", "r0", "r4", "s4", "r3", "r2"],
    ]
    assert plan(mixture(), 2).hash == "c56c5efc5e92c95883880be73d6c59cd0ebfcdc6ffe7080d56e2e07c1809c1c7"
    assert rows(plan(mixture(balanced=True), 0)) == ["r3", "s1", "r1", "r0", "r2", "s0", "r4", "r5"]
    two = Mixture((Part(3), Part(2)), (Part(None), Part(4)), make_schedule(0.5), seed=7, epoch_size="replace")
    made = plan(two, 1)
    assert list(zip(made.source.tolist(), made.index.tolist(), strict=True)) == [(2, 2), (0, 0), (3, 1), (2, 3), (1, 0)]


@settings(max_examples=60)
@given(
    real=st.integers(1, 40), hundredths=st.integers(0, 100), seed=st.integers(0, 2**64 - 1),
    epoch=st.integers(0, 10**6), size=st.sampled_from(["add", "replace", 1, 7, 50]), balanced=st.booleans(),
)  # fmt: skip
def test_counts_are_exact(real: int, hundredths: int, seed: int, epoch: int, size: str | int, balanced: bool) -> None:
    share = Fraction(hundredths, 100)
    assume(share < 1 or size != "add")
    made = plan(mixture(real, hundredths / 100, seed=seed, epoch_size=size, balanced=balanced), epoch)
    synthetic = int(made.domain.sum())
    if size == "add":
        assert sorted(made.index[~made.domain]) == list(range(real))
        assert abs(synthetic - real * share / (1 - share)) <= Fraction(1, 2)
    else:
        assert len(made) == (real if size == "replace" else size)
        assert synthetic == floor(len(made) * share + Fraction(1, 2))


@settings(max_examples=30)
@given(st.integers(1, 7), st.sampled_from([0.1, 0.25, 1 / 3, 0.5, 0.8]), st.sampled_from(["add", "replace", 23]))
def test_running_indices(real: int, ratio: float, size: str | int) -> None:
    """Over the epochs, real scans are given equally often, up to one, and synthetic ones once each, in turn."""
    mixed = mixture(real, ratio, epoch_size=size)
    given_reals: Counter[int] = Counter(dict.fromkeys(range(real), 0))
    synthetic: list[int] = []
    for epoch in range(6):
        made = plan(mixed, epoch)
        given_reals.update(made.index[~made.domain].tolist())
        fresh = sorted(made.index[made.domain].tolist())
        assert fresh == list(range(len(synthetic), len(synthetic) + len(fresh)))
        synthetic += fresh
        assert max(given_reals.values()) - min(given_reals.values()) <= 1


def test_reuse_divides_and_a_bank_begins_again() -> None:
    counts: Counter[int] = Counter()
    for epoch in range(4):
        made = plan(mixture(9, 0.5, reuse=3), epoch)
        counts.update(made.index[made.domain].tolist())
    assert counts == dict.fromkeys(range(12), 3)
    bank = Mixture((Part(6),), (Part(4),), make_schedule(0.5), reuse=2)
    indices = [sorted(plan(bank, e).index[plan(bank, e).domain].tolist()) for e in range(3)]
    assert indices == [[0, 0, 1, 1, 2, 2], [0, 0, 1, 1, 3, 3], [0, 0, 2, 2, 3, 3]]


def test_weights_are_kept_by_largest_remainders() -> None:
    assert largest_remainders(10, [Fraction(1), Fraction(1), Fraction(1)]) == (4, 3, 3)
    assert largest_remainders(7, [Fraction(5), Fraction(3), Fraction(1)]) == (4, 2, 1)
    assert largest_remainders(0, []) == ()
    parts = (Part(10, 1.0), Part(30, 3.0)), (Part(None, 1.0), Part(None, 2.0), Part(5, 1.0))
    assert quotas(Mixture(*parts, make_schedule(0.4), epoch_size=50), 3) == (8, 22, 5, 10, 5)
    unweighted = Mixture((Part(10), Part(30)), (ENDLESS, Part(5)), make_schedule(0.4), epoch_size=50)
    assert quotas(unweighted, 0) == (8, 22, 10, 10)


@settings(max_examples=60)
@given(st.integers(8, 200), st.fractions(0, 1, max_denominator=20), st.integers(1, 12))
def test_a_balanced_plan_is_exact_in_every_batch(total: int, share: Fraction, batch: int) -> None:
    domain = plan(mixture(5, float(share), epoch_size=total, balanced=True), 4).domain
    for start in range(0, total - batch + 1, batch):
        difference = int(domain[start : start + batch].sum()) - batch * share
        assert abs(difference) < 1
        assert (batch * share).denominator > 1 or difference == 0


SCHEDULES: list[tuple[object, list[float]]] = [
    (0.25, [0.25] * 5),
    ([0.1, 0.2, 0.3, 0.4, 0.5], [0.1, 0.2, 0.3, 0.4, 0.5]),
    ({0: 0.5, 3: 0.25}, [0.5, 0.5, 0.5, 0.25, 0.25]),
    (Linear(0.0, 0.5, 3), [0.0, 0.25, 0.5, 0.5, 0.5]),
    (lambda epoch: 1 / (epoch + 2), [1 / 2, 1 / 3, 1 / 4, 1 / 5, 1 / 6]),
]


@pytest.mark.parametrize(("ratio", "expected"), SCHEDULES)
def test_schedules(ratio: object, expected: list[float]) -> None:
    schedule: Schedule = make_schedule(ratio)  # type: ignore[arg-type]
    assert [float(share_of(schedule, epoch)) for epoch in range(5)] == pytest.approx(expected, abs=1e-6)
    mixed = mixture(7, ratio)
    before = (0, 0)
    for epoch in range(5):
        assert running_counts(mixed, epoch) == before
        before = tuple(np.add(before, quotas(mixed, epoch)).tolist())  # type: ignore[assignment]


def test_a_late_epoch_costs_no_more_than_the_first() -> None:
    calls: list[int] = []

    class Counted(Linear):
        def __call__(self, epoch: int) -> float:
            calls.append(epoch)
            return super().__call__(epoch)

    assert running_counts(mixture(3, Counted(0.0, 0.5, 4)), 10**9) == (3 * 10**9, 1 + 2 + 3 * (10**9 - 3))
    assert len(calls) < 10


def test_a_tenth_is_a_tenth() -> None:
    assert share_of(make_schedule(0.1), 0) == Fraction(1, 10)
    assert quotas(mixture(1, 0.1, epoch_size=5), 0) == (4, 1)  # half of one counts as one


def test_the_hash_tells_plans_apart() -> None:
    one = plan(mixture(), 0).hash
    others = [
        plan(mixture(), 1), plan(mixture(seed=1), 0), plan(mixture(ratio=0.5), 0), plan(mixture(balanced=True), 0),
        plan(Mixture((Part(6, identity="real"),), (Part(None, identity="other"),), make_schedule(0.25)), 0),
    ]  # fmt: skip
    assert one == plan(mixture(), 0).hash
    assert len({one, *(other.hash for other in others)}) == 6


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


def test_what_is_left_is_left_for_any_number_of_ranks() -> None:
    for step in cut_steps(0, 23, 2, 3):
        for batch, ranks in ((1, 1), (4, 2), (2, 3), (3, 4)):
            rest = [i for s in cut_steps(step.stop, 23, batch, ranks) for i in s]
            assert rest == list(range(step.stop, 23))


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: mixture(ratio=1.2), ConfigError, r"ratio 1.2 in epoch 0; expected the share .* from 0 to 1"),
        (lambda: mixture(ratio=-0.1), ConfigError, r"ratio -0.1"),
        (lambda: mixture(ratio=float("nan")), ConfigError, r"ratio nan"),
        (lambda: mixture(ratio="a quarter"), ConfigError, r"ratio 'a quarter'"),
        (lambda: mixture(ratio=[0.5, 2]), ConfigError, r"ratio 2 in epoch 1"),
        (lambda: mixture(ratio=[]), ConfigError, r"a ratio from epoch 0 on"),
        (lambda: mixture(ratio={1: 0.5}), ConfigError, r"a ratio from epoch 0 on"),
        (lambda: mixture(ratio=Linear(0, 0.5, 1)), ConfigError, r"over 1 epochs; expected at least 2"),
        (lambda: plan(mixture(ratio=[0.5, 0.4]), 2), ConfigError, r"epoch 2 of a ratio schedule for 2 epochs.*longer"),
        (lambda: plan(mixture(ratio=lambda e: e * 0.6), 2), ConfigError, r"ratio 1.2 in epoch 2"),
        (lambda: plan(mixture(), -1), ConfigError, r"epoch -1"),
        (lambda: mixture(ratio=1.0), ConfigError, r"ratio 1 .*epoch_size='add'.*Use epoch_size='replace' or"),
        (lambda: mixture(epoch_size="double"), ConfigError, r"epoch_size='double'; expected 'add', 'replace' or"),
        (lambda: mixture(epoch_size=0), ConfigError, r"epoch_size=0"),
        (lambda: mixture(reuse=0), ConfigError, r"reuse=0"),
        (lambda: mixture(seed=-1), ConfigError, r"seed -1"),
        (lambda: mixture(real=0), DataError, r"a source without scans"),
        (lambda: Mixture((), (ENDLESS,), make_schedule(0.5), epoch_size=4), DataError, r"no real scans.*ratio=1"),
        (lambda: Mixture((), (ENDLESS,), make_schedule(1.0)), DataError, r"no real scans.*give epoch_size"),
        (lambda: Mixture((Part(3),), (), make_schedule(0.5)), ConfigError, r"ratio 0.5 .* without a synthetic source"),
        (lambda: Mixture((Part(3, 1.0),), (ENDLESS,), make_schedule(0.5)), ConfigError, r"weights of real sources"),
        (lambda: Mixture((Part(3),), (Part(3, 0.0),), make_schedule(0.5)), ConfigError, r"weight 0.0"),
    ],
)  # fmt: skip
def test_what_cannot_be_planned(make: object, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        make()  # type: ignore[operator]


def test_synthetic_only_and_real_only() -> None:
    only = Mixture((), (ENDLESS,), make_schedule(1), epoch_size=5)
    assert sorted(plan(only, 1).index.tolist()) == [5, 6, 7, 8, 9]
    assert plan(Mixture((Part(4),), (), make_schedule(0)), 0).domain.tolist() == [False] * 4
