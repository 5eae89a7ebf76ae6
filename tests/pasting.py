"""What several tests of this part share."""

import numpy as np

from lidar_synth.geometry.scan import Boxes, Scan
from lidar_synth.labels.ground import FLOOR


def assert_nothing_shares_a_ray(scan: Scan, first: int) -> None:
    """Brute force over the instances from ``first`` on: a box holds its object and, else, ground
    only; no other return lies behind the outline of an object, nor in a cell that shows it."""
    assert scan.boxes is not None and scan.instance is not None
    height, width = scan.sensor.shape
    x, y, z = scan.points.astype(np.float64).T
    distance = np.sqrt(x * x + y * y + z * z)
    column = np.floor((1 - np.arctan2(y, x) / np.pi) / 2 * width).astype(int) % width
    edges = scan.sensor.edges.astype(np.float64)
    row = np.clip(
        np.searchsorted(-edges, -np.arcsin(z / distance), side="right") - 1,
        0,
        height - 1,
    )
    for box, instance in zip(scan.boxes.values, scan.boxes.instance, strict=True):
        if instance < first:
            continue
        own = scan.instance == instance
        one = Boxes(box, ("Car",))
        assert one.contain(scan.points[own]).all() and own.any()
        assert own[one.contain(scan.points, above_floor=2 * FLOOR)[0]].all()
        for c in np.unique(column[own]):
            mine = own & (column == c)
            others = ~own & (column == c)
            assert not set(row[mine]) & set(row[others])
            between = others & (row > row[mine].min()) & (row < row[mine].max())
            assert (distance[between] <= distance[mine].min() + 1e-3).all()
