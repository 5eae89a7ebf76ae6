"""Scans in Rerun: its own reader finds what was logged."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from layouts import a_pose, some_boxes, some_scan

from lidar_synth.datasets.colours import COLOURS
from lidar_synth.errors import ConfigError
from lidar_synth.viz import to_rerun


def logged(stream: Any, path: Path) -> dict[tuple[str, str], list[Any]]:
    """{(entity, component): values by scan} of a recording that was saved."""
    chunk = pytest.importorskip("rerun.chunk")
    stream.save(path)
    stream.flush()
    stream.disconnect()
    found: dict[tuple[str, str], dict[int, Any]] = {}
    for part in chunk.RrdReader(path).stream():
        table = part.to_record_batch()
        times = table["scan"].to_pylist() if "scan" in table.schema.names else []
        for name in table.schema.names:
            values = table[name].to_pylist()
            rows = found.setdefault((part.entity_path.strip("/"), name), {})
            rows |= dict(zip(times, values, strict=False))
    return {key: [rows[n] for n in sorted(rows)] for key, rows in found.items()}


def test_points_boxes_and_poses_are_logged(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    scans = [
        replace(some_scan(0), boxes=some_boxes(0), pose=a_pose(0)),
        replace(some_scan(1), boxes=None, pose=None, label=None),
    ]
    found = logged(to_rerun(scans), tmp_path / "a.rrd")
    for number, scan in enumerate(scans):
        points = found["world/sensor/points", "Points3D:positions"][number]
        assert np.array_equal(np.asarray(points, np.float32), scan.points)
        pose = np.eye(4) if scan.pose is None else scan.pose
        [place] = found["world/sensor", "Transform3D:translation"][number]
        np.testing.assert_allclose(place, pose[:3, 3], rtol=1e-6)
        [turn] = found["world/sensor", "Transform3D:mat3x3"][number]
        np.testing.assert_allclose(np.reshape(turn, (3, 3)).T, pose[:3, :3], atol=1e-6)
        boxes = found["world/sensor/boxes", "Boxes3D:labels"][number]
        assert boxes == ([] if scan.boxes is None else list(scan.boxes.names))
    assert scans[0].boxes is not None and scans[0].label is not None
    yaw = scans[0].boxes.values[:, 6]
    turns = np.array(found["world/sensor/boxes", "Boxes3D:quaternions"][0])
    np.testing.assert_allclose(2 * np.arctan2(turns[:, 2], turns[:, 3]), yaw, rtol=1e-5)
    known = scans[0].label < len(COLOURS)
    colours = np.array(found["world/sensor/points", "Points3D:colors"][0])
    red = np.asarray(COLOURS)[scans[0].label[known], 0]
    assert np.array_equal(colours[known] >> 24, red)


def test_points_are_coloured_by_a_quantity_that_they_have(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    scan = some_scan()
    by = [
        logged(to_rerun(scan, by), tmp_path / f"{by}.rrd") for by in ("range", "height")
    ]
    one, other = (found["world/sensor/points", "Points3D:colors"] for found in by)
    assert one != other
    with pytest.raises(ConfigError, match="colour by 'colour'"):
        to_rerun(scan, "colour")


def test_without_the_extra_the_error_says_what_to_install() -> None:
    program = (
        "import sys; sys.modules['rerun'] = None\n"
        "from lidar_synth import sample_scans\n"
        "from lidar_synth.viz import to_rerun\n"
        "to_rerun(sample_scans()[0])"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert "pip install 'lidar_synth[rerun]'" in done.stderr
