"""Distances, their resampling and intervals, and neighbours in feature space, against independent
float64 code."""

from collections.abc import Callable

import numpy as np
import pytest
from project import ROOT
from scipy.linalg import sqrtm
from scipy.spatial.distance import cdist, jensenshannon

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.lab.evaluate import frechet_distance
from lidar_synth.lab.evaluate.intervals import bootstrap, extrapolated_frechet
from lidar_synth.lab.evaluate.measures import normalised_rows, total_variation
from lidar_synth.lab.evaluate.neighbours import manifold, nearest_training
from lidar_synth.lab.evaluate.statistics import (
    Statistic,
    frechet,
    gaussian_mmd,
    histogram_distance,
    polynomial_mmd,
    share,
    smallest_of_pairs,
)

RNG = np.random.default_rng(0)
COUNTS = [RNG.poisson(3, (n, 4, 5)).astype(np.uint32) for n in (7, 5)]
FEATURES = [RNG.normal(k, 1, (n, 3)) for k, n in ((0, 30), (1, 20))]
Sets = list[np.ndarray]


def histograms_mmd(real: np.ndarray, fake: np.ndarray) -> Statistic:
    return gaussian_mmd(
        normalised_rows(real),
        normalised_rows(fake),
        (len(real), len(fake)),
        real[0].size,
    )


def squared(real: np.ndarray, fake: np.ndarray) -> Statistic:
    return smallest_of_pairs(cdist(real, fake, "sqeuclidean"))


def mmd_by_definition(a: np.ndarray, b: np.ndarray) -> float:
    p, q = (h.reshape(len(h), -1).astype(np.float64) for h in (a, b))
    p, q = (h / h.sum(1, keepdims=True) for h in (p, q))
    kernel = lambda x, y: np.exp(-2 * cdist(x, y, "sqeuclidean")).mean()  # noqa: E731
    return float(kernel(p, p) + kernel(q, q) - 2 * kernel(p, q))


def frechet_by_definition(a: np.ndarray, b: np.ndarray) -> float:
    covariances = np.cov(a.T), np.cov(b.T)
    root = sqrtm(covariances[0] @ covariances[1]).real
    return float(
        ((a.mean(0) - b.mean(0)) ** 2).sum() + np.trace(sum(covariances) - 2 * root)
    )


def kernel_by_pairs(a: np.ndarray, b: np.ndarray) -> float:
    kernel = lambda x, y: (x @ y / a.shape[1] + 1) ** 3  # noqa: E731
    within = [
        np.mean(
            [kernel(s[i], s[j]) for i in range(len(s)) for j in range(len(s)) if i != j]
        )
        for s in (a, b)
    ]
    return float(sum(within) - 2 * np.mean([[kernel(x, y) for y in b] for x in a]))


CASES: dict[
    str,
    tuple[Callable[..., Statistic], Sets, Callable[[np.ndarray, np.ndarray], float]],
] = {
    "jsd": (
        histogram_distance,
        COUNTS,
        lambda a, b: jensenshannon(a.sum(0).ravel(), b.sum(0).ravel()),
    ),
    "tv": (
        lambda a, b: histogram_distance(a, b, total_variation),
        COUNTS,
        lambda a, b: np.abs(a.sum(0) / a.sum() - b.sum(0) / b.sum()).sum(),
    ),
    "mmd": (histograms_mmd, COUNTS, mmd_by_definition),
    "frechet": (frechet, FEATURES, frechet_by_definition),
    "kernel": (polynomial_mmd, FEATURES, kernel_by_pairs),
    "matching": (
        squared,
        FEATURES,
        lambda a, b: cdist(a, b, "sqeuclidean").min(1).mean(),
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_values_are_those_of_float64_definitions(name: str) -> None:
    make, (a, b), definition = CASES[name]
    assert make(a, b).value == pytest.approx(definition(a, b), rel=1e-6, abs=1e-7)


@pytest.mark.parametrize("name", CASES)
def test_equal_sets_are_0_apart(name: str) -> None:
    make, (a, _), _ = CASES[name]
    # Which is unbiased, not 0.
    assert make(a, a).value == pytest.approx(0, abs=1e-7) or name == "kernel"


@pytest.mark.parametrize("name", [name for name in CASES if name != "kernel"])
def test_counts_are_repetitions(name: str) -> None:
    make, (a, b), _ = CASES[name]
    rng = np.random.default_rng(3)
    counts = [rng.multinomial(len(s), np.full(len(s), 1 / len(s)), 2) for s in (a, b)]
    together = make(a, b).at(*counts)
    for value, p, q in zip(together, *counts, strict=True):
        assert value == pytest.approx(
            make(np.repeat(a, p, 0), np.repeat(b, q, 0)).value, rel=1e-5, abs=1e-7
        )


def test_copies_in_a_resample_are_no_pair_of_the_unbiased_kernel_distance() -> None:
    a, b = FEATURES
    counts = np.r_[2, np.ones(len(a) - 1, int)][None]
    value = polynomial_mmd(a, b).at(counts, np.ones((1, len(b)), int))[0]
    kernel = (a @ a.T / 3 + 1) ** 3
    weights = counts.T * counts
    within = (weights * kernel)[~np.eye(len(a), dtype=bool)].sum() / weights[
        ~np.eye(len(a), dtype=bool)
    ].sum()
    # twice the mean within b
    others = kernel_by_pairs(b, b) + 2 * ((b @ b.T / 3 + 1) ** 3).mean()
    across = (counts @ (a @ b.T / 3 + 1) ** 3).mean() / counts.sum()
    assert value == pytest.approx(within + others / 2 - 2 * across, rel=1e-9)


@pytest.mark.parametrize("samples", [(3, 4), (5, 40)])
def test_covariances_without_full_rank(samples: tuple[int, int]) -> None:
    """The trace of the root is a nuclear norm of the centred samples, whatever their rank."""
    rng = np.random.default_rng(1)
    a, b = (rng.normal(k, 1, (n, 12)) for k, n in enumerate(samples))
    p, q = ((s - s.mean(0)) / np.sqrt(len(s) - 1) for s in (a, b))
    cross = np.linalg.svd(p @ q.T, compute_uv=False).sum()
    expected = (
        ((a.mean(0) - b.mean(0)) ** 2).sum() + (p**2).sum() + (q**2).sum() - 2 * cross
    )
    assert frechet_distance(a, b) == pytest.approx(expected, rel=1e-6)
    assert frechet_distance(a, a) == pytest.approx(0, abs=1e-6)


def test_the_extrapolated_frechet_distance_loses_most_of_the_bias() -> None:
    rng = np.random.default_rng(0)
    pairs = [rng.normal(size=(2, 150, 8)) for _ in range(8)]  # the true distance is 0
    biased, extrapolated = (
        np.mean([f(*p) for p in pairs])
        for f in (frechet_distance, extrapolated_frechet)
    )
    assert biased > 0.15 and abs(extrapolated) < biased / 4
    with pytest.raises(
        DataError,
        match="10 and 30 samples of 8 features; expected more than 16 samples",
    ):
        extrapolated_frechet(pairs[0][0][:10], pairs[0][1][:30])


# --- intervals
# --------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", ["JSD, 30 scans", "unbiased squared MMD, 100 samples"])
def test_intervals_cover_the_truth(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """With 200 trials, 92 to 98 % is two standard deviations; the tool measures all of them with
    more trials."""
    monkeypatch.syspath_prepend(str(ROOT / "tools" / "research"))
    import interval_coverage

    share, _ = interval_coverage.coverage(
        interval_coverage.SIMULATIONS[name], trials=200, replicates=100
    )
    assert 0.92 <= share <= 0.98


def test_an_interval_narrows_with_more_samples_and_repeats_with_its_seed() -> None:
    rng = np.random.default_rng(0)
    few, many = (
        frechet(rng.normal(size=(n, 2)), rng.normal(1, 1, (n, 2))) for n in (40, 400)
    )
    assert bootstrap(few, 100) == bootstrap(few, 100) != bootstrap(few, 100, seed=1)
    narrow = bootstrap(many, 100)
    wide = bootstrap(few, 100)
    assert narrow.high - narrow.low < (wide.high - wide.low) / 2
    assert (
        wide.low
        <= bootstrap(few, 100, level=0.5).low
        < bootstrap(few, 100, level=0.5).high
        <= wide.high
    )
    equal = bootstrap(frechet(*[rng.normal(size=(40, 2))] * 2), 50, smallest=0.0)
    assert equal.low == 0.0 <= equal.high
    nearly_all = share(np.r_[np.ones(28), 0, 0], True, 30)
    assert (
        bootstrap(nearly_all, 50, largest=1.0).high
        == 1.0
        < bootstrap(nearly_all, 50).high
    )


def test_the_corrected_value_is_nearer_to_the_truth_than_one_of_few_samples() -> None:
    """The Frechet distance of two sets from the same distribution is 0."""
    rng = np.random.default_rng(0)
    pairs = [frechet(*rng.normal(size=(2, 40, 4))) for _ in range(20)]
    values = np.mean([statistic.value for statistic in pairs])
    corrected = np.mean([bootstrap(one, 100).corrected for one in pairs])
    assert abs(corrected) < 0.3 * values


def test_intervals_refuse_what_cannot_give_one() -> None:
    one = smallest_of_pairs(np.ones((1, 5)))
    with pytest.raises(
        DataError, match="1 real and 5 generated samples; expected at least two of each"
    ):
        bootstrap(one)
    for options in ({"level": 1.0}, {"replicates": 3}):
        with pytest.raises(ConfigError, match="a level in"):
            bootstrap(smallest_of_pairs(np.ones((5, 5))), **options)


def test_a_resample_without_a_value_gives_no_interval() -> None:
    """Of one sample that is drawn every time, the unbiased kernel distance has no pair."""
    rng = np.random.default_rng(0)
    few, many = (polynomial_mmd(*rng.normal(size=(2, n, 3))) for n in (3, 30))
    assert np.isfinite(few.value) and bootstrap(few) is None
    interval = bootstrap(many, 50)
    assert interval is not None and np.isfinite(interval).all()


# --- neighbours
# --------------------------------------------------------------------------------------------------


def test_precision_recall_density_and_coverage_by_hand() -> None:
    """On a line, k = 1: the balls of 0, 1, 3, 7 have radii 1, 1, 2, 4; those of 1.6, 1.9, 30 have
    0.3, 0.3, 28.1."""
    real = np.array([[0.0], [1], [3], [7]])
    fake = np.array([[1.6], [1.9], [30.0]])
    found = manifold(real, fake, k=1)
    assert found.precision.value == pytest.approx(2 / 3)  # 30 lies in no real ball
    # 1.6 is in the balls of 1 and 3, and so is 1.9.
    assert found.density.value == pytest.approx((2 + 2 + 0) / 3)
    # 3 and 7 are in the ball of 30, 0 and 1 in none.
    assert found.recall.value == pytest.approx(2 / 4)
    # The balls of 1 and 3 hold 1.6, those of 0 and 7 nothing.
    assert found.coverage.value == pytest.approx(2 / 4)


def test_neighbours_tell_fidelity_from_diversity() -> None:
    rng = np.random.default_rng(0)
    real = rng.normal(size=(300, 4))
    good, narrow, wide = (
        manifold(real, s * rng.normal(size=(300, 4))) for s in (1, 0.2, 5)
    )
    assert min(s.value for s in good) > 0.7
    assert narrow.precision.value > 0.95 and narrow.recall.value < 0.2
    assert wide.precision.value < 0.4 and wide.coverage.value < good.coverage.value / 2
    assert [s.value for s in manifold(real, real)][:2] == [1, 1]
    low, high, corrected = bootstrap(good.precision, 100)
    assert 0 < high - low < 0.2 and low <= corrected <= high
    with pytest.raises(
        DataError,
        match="3 real and 300 generated samples; expected more than k = 5 of each",
    ):
        manifold(real[:3], real)


def test_copies_of_training_scans_are_found() -> None:
    rng = np.random.default_rng(0)
    training, held_out, new = rng.normal(size=(3, 200, 4))
    honest, copied = (
        nearest_training(training, s, held_out)
        for s in (new, np.r_[training[:50] + 1e-3, new[:150]])
    )
    assert honest.closer < 0.12 and copied.closer > 0.25
    assert np.allclose(copied.generated[:50], 2e-3, atol=1e-3)
    assert np.allclose(honest.held_out, cdist(held_out, training).min(1))
