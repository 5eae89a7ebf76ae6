"""Labels from the nearest points of a cloud, against a search through all points."""

import numpy as np
import pytest

from lidar_synth.lab.kitti360.nearest import VOXEL, NearestLabels, index_cloud

SIZE = 4.0
LOW = np.zeros(3)
HIGH = np.full(3, SIZE)


def cloud(
    count: int, seed: int = 0, chunks: int = 1, *, low: float = 0.0, high: float = SIZE
) -> NearestLabels:
    rng = np.random.default_rng(seed)
    points = rng.uniform(low, high, (count, 3))
    values = rng.integers(1, 5, count).astype(np.uint32)
    confidence = rng.uniform(0.2, 1, count).astype(np.float32)
    cuts = np.array_split(np.arange(count), chunks)
    return index_cloud([(points[c], values[c], confidence[c]) for c in cuts], LOW, HIGH)


@pytest.mark.parametrize("radius", [0.05, 0.3, 0.7])
def test_the_vote_is_that_of_a_search_through_all_points(radius: float) -> None:
    index = cloud(3000)
    queries = np.random.default_rng(1).uniform(-0.5, SIZE + 0.5, (400, 3))
    vote = index.vote(queries, radius)
    for i, query in enumerate(queries):
        distance = np.linalg.norm(index.points - query, axis=1)
        near = np.argsort(distance)[:3]
        near = near[distance[near] < radius]
        if not len(near):
            assert (
                vote.value[i] == 0 and vote.share[i] == 0 and np.isinf(vote.distance[i])
            )
            continue
        weights = 1 / (distance[near] + 0.02)
        trust = {
            v: (weights * index.confidence[near])[index.values[near] == v].sum()
            for v in index.values[near]
        }
        best = max(trust, key=lambda v: trust[v])
        assert vote.value[i] == best
        own = index.values[near] == best
        assert vote.share[i] == pytest.approx(
            trust[best] / sum(trust.values()), rel=1e-3
        )
        assert vote.trust[i] == pytest.approx(
            trust[best] / weights[own].sum(), rel=1e-3
        )
        assert vote.distance[i] == pytest.approx(
            distance[near][index.values[near] == best].min(), rel=1e-3
        )


def test_a_cloud_in_parts_gives_the_same_index() -> None:
    whole = cloud(3000)
    parts = cloud(3000, chunks=7)
    assert all(
        np.array_equal(getattr(whole, n), getattr(parts, n))
        for n in ("points", "values")
    )


def test_points_of_one_class_in_one_cube_become_one_and_other_classes_stay() -> None:
    points = np.full((5, 3), 1.01) + np.linspace(0, VOXEL / 2, 5)[:, None]
    values = np.array([7, 7, 8, 8, 7], np.uint32)
    index = index_cloud([(points, values, np.ones(5, np.float32))], LOW, HIGH)
    assert sorted(index.values.tolist()) == [7, 8]


def test_points_outside_the_volume_and_nan_are_left_out() -> None:
    points = np.array(
        [(1, 1, 1), (-1, 1, 1), (1, SIZE + 1, 1), (1, 1, np.nan)], np.float64
    )
    index = index_cloud(
        [(points, np.ones(4, np.uint32), np.ones(4, np.float32))], LOW, HIGH
    )
    assert len(index) == 1


def test_a_volume_may_be_of_any_size() -> None:
    far = np.array([[9000.0, 1, 900]])
    one = [(far, np.ones(1, np.uint32), np.ones(1, np.float32))]
    index = index_cloud(one, LOW, np.full(3, 1e4))
    assert index.vote(far, 0.1).value.tolist() == [1]


def test_an_empty_cloud_labels_nothing() -> None:
    for index in (index_cloud([], LOW, HIGH), cloud(0)):
        vote = index.vote(np.ones((3, 3)), 0.5)
        assert not vote.value.any() and np.isinf(vote.distance).all()
    assert len(cloud(10).vote(np.zeros((0, 3)), 0.5).value) == 0
