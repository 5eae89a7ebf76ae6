"""Edited scans keep their boxes true; ``tools/research/edit_trial.py --inserts 500`` measures the
same on more scans."""

import sys

import numpy as np
import pytest
from project import ROOT

from lidar_synth import Town, load_sensor

sys.path.append(str(ROOT / "tools" / "research"))

from edit_trial import FAR, SENSORS, grown_by, outside_share


@pytest.mark.parametrize("sensor", SENSORS)
def test_a_box_keeps_the_size_of_its_object(sensor: str) -> None:
    scan = Town(seed=40, scans=2, sensor=load_sensor(sensor))[1]
    growth = grown_by([scan], 12)
    assert len(growth) == 12 and np.abs(growth).max() < 0.2


def test_vehicles_of_a_transfer_stay_in_their_boxes() -> None:
    """Roofs and bonnets end; only the ground reaches on behind its last return."""
    scan = Town(seed=40, scans=2, sensor=load_sensor("hdl32e_nuscenes"))[1]
    assert FAR == 2 and outside_share([scan], SENSORS) <= 0.001
