"""Isolated returns: counted as defined, and absent from what a decoder samples."""

import numpy as np
import pytest
from hypothesis import given, strategies as st

from lidar_synth import Town, load_generator
from lidar_synth.datasets.classes import TRAIN_ID
from lidar_synth.generate.support import find_unsupported
from lidar_synth.geometry.scan import Scan
from lidar_synth.geometry.sensor import load_sensor
from lidar_synth.lab.evaluate.isolated import (
    count_isolated,
    isolated_ratio,
    share_of_isolated,
)

WIDTH = 1024


def wall(distance: float = 12.0) -> np.ndarray:
    """A scan of a cylinder around the sensor: every return has support."""
    return np.full((16, WIDTH), distance, np.float32)


@given(
    row=st.integers(0, 15), column=st.integers(0, WIDTH - 1), factor=st.floats(1.1, 3)
)
def test_a_return_behind_a_wall_has_no_support(
    row: int, column: int, factor: float
) -> None:
    image = wall()
    image[row, column] *= factor
    found = find_unsupported(image[None])[0]
    assert found[row, column] and found.sum() == 1


def test_a_pole_before_a_wall_has_support() -> None:
    image = wall()
    image[4:12, 100:102] = 8
    image[4:12, -1] = 8  # across the seam
    image[4:12, 0] = 8
    assert not find_unsupported(image[None]).any()


def test_two_returns_do_not_support_each_other() -> None:
    image = wall()
    image[5, 7:9] = 20
    found = find_unsupported(image[None])[0]
    assert set(zip(*found.nonzero(), strict=True)) == {(5, 7), (5, 8)}


def test_empty_cells_are_no_returns() -> None:
    assert not find_unsupported(np.zeros((2, 4, WIDTH), np.float32)).any()


def test_isolated_returns_are_counted_by_class() -> None:
    x = np.arange(100)
    line = np.stack([np.full(100, 10.0), 0.05 * x - 2.5, np.zeros(100)], axis=1)
    alone = np.array([[20.0, 0, 0], [0, 15, 0], [60, 0, 0], [0, 0.1, 0]])
    points = np.concatenate([line, alone]).astype(np.float32)
    label = np.full(len(points), TRAIN_ID["building"], np.uint8)
    label[100] = TRAIN_ID["pole"]
    label[101] = 255
    scan = Scan(
        points, np.zeros(len(points), np.float32), load_sensor("town"), label=label
    )
    counts = count_isolated(scan)
    assert counts[:, TRAIN_ID["building"]].tolist() == [0, 100]
    assert counts[:, TRAIN_ID["pole"]].tolist() == [1, 1]
    assert counts[:, -1].tolist() == [1, 1]
    assert counts.sum(1).tolist() == [2, 102]  # the far and the near one do not count
    assert count_isolated(scan[100:103]).sum(1).tolist() == [2, 2]  # no neighbours
    doubled = isolated_ratio([counts], [counts * [[2], [1]]])
    assert doubled.value == pytest.approx(2)


@pytest.mark.slow
def test_generated_scans_have_hardly_more_isolated_returns_than_the_town() -> None:
    town = Town(11, "hdl64e_lasers", scans=13, motion=False)
    real = sum(count_isolated(town[i]) for i in (0, 6, 12))
    for steps in (4, 1):
        scans = load_generator("town").scans(0, [0, 1, 2], steps=steps)
        fake = sum(map(count_isolated, scans))
        shares = [share_of_isolated(counts.sum(1)) for counts in (real, fake)]
        assert shares[1] < 1.5 * shares[0]  # 2.1 % before, 0.3 % in the town
