"""From sensor to sensor: range images with fewer columns than their sensor fires."""

from dataclasses import replace

import numpy as np

from lidar_synth import Town
from lidar_synth.geometry.projection import project, unproject
from lidar_synth.geometry.sensor import load_sensor
from lidar_synth.geometry.transfer import Transfer
from lidar_synth.geometry.transfer.surfaces import as_fired, rings_of


def test_a_sensor_fires_once_per_column_in_a_range_image() -> None:
    """Its neighbours are of one surface, and its returns are not kept for a sensor that fires more
    often; a scan that lost most of its returns is no range image."""
    town = Town(seed=3, scans=1, motion=False)[0]
    grid = unproject(project(town))
    other = Transfer(load_sensor("hdl32e"))
    for seen in (grid, replace(grid, ring=None)):
        assert as_fired(seen, rings_of(seen)[0]).firings == town.sensor.columns
        assert abs(len(other(seen)) / len(other(town)) - 1) < 0.08
        filled = project(Transfer(load_sensor("hdl64e_lasers"))(seen)).mask.mean()
        assert filled > 0.7
    for share in (1.0, 0.3, 0.1, 0.03):
        some = town[np.random.default_rng(0).random(len(town)) < share]
        assert as_fired(some) is town.sensor
