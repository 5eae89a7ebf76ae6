"""Measures of realism against the numbers of both protocols, and by hand."""

from itertools import combinations

import numpy as np
import pytest
from conftest import Golden, random_scan
from hypothesis import given, strategies as st
from safetensors.numpy import load_file
from scipy.linalg import sqrtm
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist, jensenshannon

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.geometry.scan import Scan
from lidar_synth.geometry.sensor import Sensor, presets
from lidar_synth.lab.evaluate import (
    PROTOCOLS,
    Score,
    evaluate,
    frechet_distance,
    jensen_shannon_distance,
    lidm,
    r2flow,
    squared_mmd,
    statistics,
)
from lidar_synth.lab.evaluate.measures import KINDS
from lidar_synth.lab.evaluate.protocols import FEATURES

SENSOR = presets()["hdl64e_kitti360"]
PAIRS = [
    ("real", "fake", ""),
    ("real", "real", "_self"),
    ("dense_real", "dense_fake", "_dense"),
]
Vectors = dict[str, np.ndarray]


@pytest.fixture(scope="module")
def vectors(golden: Golden) -> Vectors:
    return load_file(golden / "metrics.safetensors")


def clouds(vectors: Vectors, name: str) -> list[np.ndarray]:
    return [v for k, v in sorted(vectors.items()) if k.startswith(f"clouds_{name}/")]


def scans(count: int, seed: int, scale: float = 1.0) -> list[Scan]:
    """The same street, labelled, seen with a little noise, and by ``scale`` larger or smaller."""
    street = np.random.default_rng(9).normal(0, (20, 20, 0.5), (3000, 3)) * scale
    label = np.random.default_rng(9).integers(0, 19, 3000).astype(np.uint8)
    made = []
    for i in range(count):
        points = (
            street + np.random.default_rng([seed, i]).normal(0, 0.02, street.shape)
        ).astype(np.float32)
        made.append(
            Scan(points, np.zeros(3000, np.float32), SENSOR, label, id=f"{seed}-{i}")
        )
    return made


def compared(protocol: str, name: str, real: list, fake: list) -> float:
    """The value of a protocol's measure on clouds (N, 3)."""
    measure = PROTOCOLS[protocol].measures[name]
    kind = KINDS[measure.kind]
    sides = [
        [
            kind.describe(
                Scan(c, np.zeros(len(c), np.float32), SENSOR), **measure.options
            )
            for c in side
        ]
        for side in (real, fake)
    ]
    return kind.compare(*sides, **measure.options).value


def test_r2flow_histogram(vectors: Vectors) -> None:
    histogram = r2flow.bev_histogram(clouds(vectors, "real")[0])
    assert np.array_equal(np.argwhere(histogram), vectors["r2flow/hist_real0_nonzero"])
    assert np.array_equal(histogram[histogram > 0], vectors["r2flow/hist_real0_values"])


@pytest.mark.parametrize(("real", "fake", "suffix"), PAIRS)
def test_r2flow_figures(vectors: Vectors, real: str, fake: str, suffix: str) -> None:
    both = clouds(vectors, real), clouds(vectors, fake)
    assert compared("r2flow", "jsd", *both) == pytest.approx(
        vectors[f"r2flow/jsd{suffix}"][0], rel=1e-6
    )
    assert compared("r2flow", "mmd", *both) == pytest.approx(
        vectors[f"r2flow/mmd{suffix}"][0], abs=1e-6
    )


def test_lidm_cells(vectors: Vectors) -> None:
    counts = sum(
        np.bincount(lidm.find_occupied(c, 0.05), minlength=2000**2)
        for c in clouds(vectors, "real")
    )
    assert np.array_equal(
        np.argwhere(counts.reshape(2000, 2000)), vectors["lidm/bev_sum_nonzero"]
    )
    assert np.array_equal(counts[counts > 0], vectors["lidm/bev_sum_values"])
    coarse = (
        np.stack(
            np.divmod(lidm.find_occupied(clouds(vectors, "real")[0], 0.5), 200),
            1,
        )
        / 200
    )
    assert {tuple(c) for c in coarse.astype(np.float32)} == {
        tuple(c) for c in vectors["lidm/bev_bin_real0"]
    }


@pytest.mark.parametrize(("real", "fake", "suffix"), PAIRS)
def test_lidm_figures(vectors: Vectors, real: str, fake: str, suffix: str) -> None:
    both = clouds(vectors, real), clouds(vectors, fake)
    assert compared("lidm", "jsd", *both) == pytest.approx(
        vectors[f"lidm/jsd{suffix}"][0], rel=1e-5
    )
    assert compared("lidm", "mmd", *both) == pytest.approx(
        vectors[f"lidm/mmd{suffix}"][0], rel=1e-4
    )
    # R3DPA keeps LiDM's code for it.
    assert compared("r3dpa", "jsd", *both) == compared("lidm", "jsd", *both)


@pytest.mark.slow
def test_figures_of_features(vectors: Vectors) -> None:
    a = vectors["features_a"]
    b = vectors["features_b"]
    assert frechet_distance(a, b) == pytest.approx(
        vectors["r2flow/frechet"][0], rel=1e-9
    )
    assert frechet_distance(b, a) == pytest.approx(vectors["lidm/frechet"][0], rel=1e-9)
    rng = np.random.RandomState(6003)
    assert squared_mmd(a, b, rng) == pytest.approx(
        vectors["r2flow/squared_mmd"][0], rel=1e-9
    )
    rng = np.random.RandomState(6003)
    few = squared_mmd(a, b, rng, subsets=10, size=100)
    assert few == pytest.approx(
        vectors["r2flow/squared_mmd_subsets10_size100"][0], rel=1e-9
    )


def test_squared_mmd_by_hand() -> None:
    """Kernel (x y + 1)^3. No sample is compared with itself: the unbiased estimator, which can fall
    below 0."""
    a = np.array([[0.0], [1.0]])
    b = np.array([[1.0], [2.0]])
    within = (1 + 1) / 2 + (27 + 27) / 2
    across = (1 + 1 + 8 + 27) / 4
    assert squared_mmd(a, b, subsets=3) == pytest.approx(within - 2 * across)
    assert squared_mmd(a, a, subsets=3) == pytest.approx(2 - 2 * (1 + 1 + 1 + 8) / 4)
    # subsets that would all be the whole sets are compared once
    many, one = (np.random.default_rng(0) for _ in range(2))
    squared_mmd(a, b, many, subsets=9)
    squared_mmd(a, b, one, subsets=1)
    assert many.random() == one.random()
    # All pairs of disjoint halves of one set: 0 on average.
    everything = np.arange(6.0)[:, None] / 3
    halves = [list(chosen) for chosen in combinations(range(6), 3)]
    pairs = [(h, [i for i in range(6) if i not in h]) for h in halves]
    three = [
        squared_mmd(everything[h], everything[rest], subsets=1) for h, rest in pairs
    ]
    assert np.mean(three) == pytest.approx(0, abs=1e-9)


def test_frechet_distance_by_hand() -> None:
    rng = np.random.default_rng(0)
    a = rng.normal(size=(50, 6))
    b = rng.normal(1, 2, (40, 6)) @ rng.normal(size=(6, 6))
    root = sqrtm(np.cov(a.T) @ np.cov(b.T)).real
    expected = ((a.mean(0) - b.mean(0)) ** 2).sum() + np.trace(
        np.cov(a.T) + np.cov(b.T) - 2 * root
    )
    assert frechet_distance(a, b) == pytest.approx(expected, rel=1e-9)
    assert frechet_distance(a, a) == pytest.approx(0, abs=1e-9)
    assert frechet_distance(a, a + 3) == pytest.approx(6 * 9)
    few = a[:3]  # covariances of rank 2 in 6 dimensions
    assert frechet_distance(few, few + 1) == pytest.approx(6, abs=1e-6)
    assert frechet_distance(few, few.astype(np.float32)) == pytest.approx(0, abs=1e-6)
    # Never below, by rounding.
    assert all(frechet_distance(f, f) >= 0 for f in rng.normal(size=(20, 6, 60)))


@given(data=st.data(), bins=st.integers(1, 20))
def test_jensen_shannon_distance_is_scipys(data: st.DataObject, bins: int) -> None:
    weights = st.lists(st.integers(0, 9), min_size=bins, max_size=bins).filter(any)
    p = np.array(data.draw(weights))
    q = np.array(data.draw(weights))
    assert jensen_shannon_distance(p, q) == pytest.approx(jensenshannon(p, q), abs=1e-7)
    assert jensen_shannon_distance(p, 3 * p) == pytest.approx(0, abs=1e-7)


@pytest.mark.parametrize("side", [40, 200])
def test_distance_maps_are_exact(side: int) -> None:
    rng = np.random.default_rng(0)
    for cells in (
        rng.choice(side**2, 300, replace=False),
        np.array([0]),
        np.arange(side),
    ):
        mask = np.zeros((side, side), bool)
        mask.flat[cells] = True
        ours = lidm._distance_map(np.sort(cells).astype(np.int32), side)
        assert np.array_equal(ours, np.round(distance_transform_edt(~mask) ** 2))


@pytest.mark.parametrize(("protocol", "cell"), [("lidm", 0.5), ("r3dpa", 0.05)])
def test_minimum_matching_distance_by_nearest_neighbours(
    protocol: str, cell: float
) -> None:
    real, fake = ([s.points for s in scans(n, seed)] for n, seed in ((5, 1), (3, 2)))
    side = lidm.cells_along(cell)
    grids = [
        [
            np.stack(np.divmod(lidm.find_occupied(p, cell), side), 1) / side
            for p in points
        ]
        for points in (real, fake)
    ]

    def chamfer(a: np.ndarray, b: np.ndarray) -> float:
        return (
            (cKDTree(b).query(a)[0] ** 2).mean() + (cKDTree(a).query(b)[0] ** 2).mean()
        ) / 2

    expected = np.mean([min(chamfer(r, f) for f in grids[1]) for r in grids[0]])
    assert compared(protocol, "mmd", real, fake) == pytest.approx(expected, rel=1e-5)


def test_maximum_mean_discrepancy_by_its_definition(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(statistics, "_NUMBERS", 0)  # blocks of 16
    real, fake = ([s.points for s in scans(n, seed)] for n, seed in ((40, 1), (18, 2)))
    p, q = (
        np.array([r2flow.bev_histogram(c).ravel() for c in side], np.float64)
        for side in (real, fake)
    )
    p, q = (h / h.sum(1, keepdims=True) for h in (p, q))
    kernel = lambda a, b: np.exp(-2 * cdist(a, b, "sqeuclidean")).mean()  # noqa: E731
    expected = kernel(p, p) + kernel(q, q) - 2 * kernel(p, q)
    assert compared("r2flow", "mmd", real, fake) == pytest.approx(expected, abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", PROTOCOLS)
def test_each_protocol_tells_near_from_far(name: str) -> None:
    real = scans(8, 0)
    same, near, far = (
        evaluate(real, s, name, anyway=True, progress=False)
        for s in (real, scans(6, 1), scans(6, 2, 0.8))
    )
    assert len(same) == sum(
        m.kind != FEATURES for m in PROTOCOLS[name].measures.values()
    )
    for zero, small, large in zip(same, near, far, strict=True):
        # The two sets are made differently.
        apart = PROTOCOLS[name].prepare.real != PROTOCOLS[name].prepare.generated
        equal = 1 if "isolated" in zero.metric else 0  # a ratio
        assert zero.value == pytest.approx(equal, abs=1e-6) or apart
        assert abs(small.value - equal) < abs(large.value - equal)
        assert (small.protocol, small.real, small.generated) == (name, 8, 6)
        assert f"({name} protocol, 8 real, 6 generated)" in str(small)


def test_the_clouds_of_the_protocols() -> None:
    scan = random_scan(SENSOR, 5000)
    own = {tuple(p) for p in scan.points}
    real, fake = (
        PROTOCOLS["r2flow"].cloud(scan, generated) for generated in (False, True)
    )
    assert (
        len(real) == len(fake)
        and {tuple(p) for p in real} <= own
        and not {tuple(p) for p in fake} & own
    )
    assert np.allclose(
        np.sort(np.linalg.norm(real, axis=1)),
        np.sort(np.linalg.norm(fake, axis=1)),
        rtol=1e-5,
    )
    assert (
        np.linalg.norm(real, axis=1).min() >= 1.45
        and 60 < np.linalg.norm(real, axis=1).max() < 63
    )
    corners = SENSOR.column_azimuths("corner")
    for name in ("lidm", "r3dpa"):
        both = [PROTOCOLS[name].cloud(scan, generated) for generated in (False, True)]
        assert np.array_equal(*both)
        assert (
            np.linalg.norm(both[0], axis=1).min() > 1
            and 53 < np.linalg.norm(both[0], axis=1).max() < 56.0001
        )
        for points in (fake, both[0]):  # every azimuth is that of a corner
            azimuth = -np.arctan2(points[:, 1], points[:, 0])
            assert np.abs(np.sin(azimuth[:, None] - corners)).min(1).max() < 1e-5
    small = Sensor("small", 64, 1.0, 90.0, rows=8, fov_up=5.0, fov_down=-20.0)
    assert len(PROTOCOLS["town"].cloud(random_scan(small), False)) <= 64 * 8
    edge = Scan(
        np.array([(1, 0, 0), (56, 0, 0), (2, 0, 0)], np.float32),
        np.zeros(3, np.float32),
        SENSOR,
    )
    assert len(PROTOCOLS["lidm"].cloud(edge, False)) == 1  # both limits are exclusive


def test_extractors_add_frechet_distances_over_all_batches() -> None:
    seen = []

    def mean_and_spread(some: list[Scan]) -> np.ndarray:
        seen.append(len(some))
        return np.stack([np.r_[s.points.mean(0), s.points.std(0)] for s in some])

    real = scans(5, 0)
    fake = scans(4, 1)
    scores = evaluate(
        real, fake, "town", {"moments": mean_and_spread}, batch=3, progress=False
    )
    assert seen == [3, 2, 3, 1]
    by_name = {s.metric: s.value for s in scores}
    a = mean_and_spread(real)
    b = mean_and_spread(fake)
    assert by_name["Frechet distance of moments"] == frechet_distance(a, b)
    assert by_name["squared maximum mean discrepancy of moments"] == squared_mmd(a, b)


def test_r2flow_takes_a_fixed_choice_of_its_limit() -> None:
    measures = {
        k: m.model_copy(update={"real": 3})
        for k, m in PROTOCOLS["r2flow"].measures.items()
    }
    limited = PROTOCOLS["r2flow"].model_copy(update={"measures": measures})
    asked = []

    class Recorded(list):
        def __getitem__(self, index: int) -> Scan:
            asked.append(index)
            return super().__getitem__(index)

    real = scans(6, 0)
    fake = scans(4, 1)
    score = evaluate(Recorded(real), fake, limited, progress=False, anyway=True)[0]
    assert asked == [4, 2, 1]  # random.Random(0).shuffle of 6 numbers, the first 3
    assert (score.real, score.generated) == (3, 4)
    everything = evaluate(
        real,
        fake,
        limited,
        {"moments": lambda some: np.ones((len(some), 2))},
        progress=False,
        anyway=True,
    )
    # Features are of all scans, as R2Flow takes them.
    assert everything[0] == score and everything[-1].real == 6


def test_bad_input() -> None:
    good = scans(2, 0)
    with pytest.raises(
        ConfigError,
        match="protocol 'jsd'; expected one of .*'lidm', 'r2flow', 'r3dpa', 'spiral', 'town'",
    ):
        evaluate(good, good, "jsd")
    with pytest.raises(DataError, match="no generated scans; expected at least one"):
        evaluate(good, [], "lidm", progress=False, anyway=True)
    empty = Scan(
        np.zeros((0, 3), np.float32), np.zeros(0, np.float32), SENSOR, id="blank"
    )
    for name, area in (
        ("r2flow", "3 m to 70 m"),
        ("lidm", r"\+-50 m"),
        ("town", "3 m to 70 m"),
    ):
        with pytest.raises(
            DataError,
            match=f"generated scan 'blank': a cloud of 0 points with none .*{area}",
        ):
            evaluate(good, [good[0], empty], name, progress=False, anyway=True)
    features = np.ones((3, 4))
    with pytest.raises(
        DataError, match="features of 3 and 1 scans; expected at least two of each"
    ):
        frechet_distance(features, features[:1])
    for a, b in ((features, features[:, :3]), (features[0], features)):
        with pytest.raises(
            DataError, match=r"features of shape .*; expected \(N, D\) and \(M, D\)"
        ):
            frechet_distance(a, b)
    with pytest.raises(DataError, match="features that are not finite"):
        squared_mmd(features, np.full((3, 4), np.nan))
    for p, q in (
        ([0, 0], [1, 1]),
        ([1, -1], [1, 1]),
        ([1, 1], [1, 1, 1]),
        ([np.nan, 1], [1, 1]),
    ):
        with pytest.raises(DataError, match="two non-negative histograms of one shape"):
            jensen_shannon_distance(np.array(p), np.array(q))


def test_a_score_reads_well() -> None:
    score = Score("BEV Jensen-Shannon distance", 0.0251234, "r2flow", 10000, 10000)
    assert (
        str(score)
        == "BEV Jensen-Shannon distance = 0.0251234 (r2flow protocol, 10000 real, 10000 generated)"
    )
