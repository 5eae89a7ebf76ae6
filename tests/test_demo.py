"""The demo: which scans it shows, and what it does to a recorded one."""

import importlib
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from conftest import random_scan
from project import ROOT

from lidar_synth import sample_scans
from lidar_synth.formats import WRITERS
from lidar_synth.geometry.sensor import load_sensor


@pytest.fixture
def demo(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    return importlib.import_module("demo")


def write_scans(layout: str, root: Path, names: list[str]) -> None:
    writer = WRITERS[layout](root)
    sensor = load_sensor("hdl64e_semantic_kitti")
    for i, name in enumerate(names):
        writer.write(replace(random_scan(sensor, 50, i), id=name), i, name=name)
    writer.finish()


@pytest.mark.parametrize(
    ("variable", "layout", "names"),
    [
        (
            "SEMANTICKITTI_ROOT",
            "semantic_kitti",
            ["00/000000", "00/000001", "04/000000"],
        ),
        ("KITTI360_ROOT", "kitti360", ["00/0", "00/1", "04/0"]),
    ],
)
def test_a_dataset_takes_the_place_of_the_sample(
    demo: ModuleType,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    variable: str,
    layout: str,
    names: list[str],
) -> None:
    write_scans(layout, tmp_path, names)
    for other in ("SEMANTICKITTI_ROOT", "KITTI360_ROOT"):
        monkeypatch.delenv(other, raising=False)
    monkeypatch.setenv(variable, str(tmp_path))
    data = demo.dataset(2)
    assert len(data.real) == 2 and data.real[0].id != data.real[1].id
    assert "Recorded scan (" in data.name and "PandaSet" not in data.name


def test_without_a_dataset_it_shows_the_scans_that_ship(
    demo: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    for variable in ("SEMANTICKITTI_ROOT", "KITTI360_ROOT"):
        monkeypatch.delenv(variable, raising=False)
    data = demo.dataset(2)
    assert [scan.id for scan in data.real] == [scan.id for scan in sample_scans()]
    assert "PandaSet" in data.name


def test_a_recorded_scan_is_changed(demo: ModuleType) -> None:
    scan = sample_scans()[0]
    recorded, fog, snow, seen, emptied = demo.change(scan)
    np.testing.assert_array_equal(recorded.points, scan.points)
    assert fog.cause is not None and snow.cause is not None
    assert seen.sensor.shape[0] == 16
    assert len(emptied.boxes) == len(scan.boxes) - 1
    gone = set(map(tuple, scan.boxes.values)) - set(map(tuple, emptied.boxes.values))
    [car] = gone
    cars = scan.boxes.values[np.array(scan.boxes.names) == "Car"]
    nearest = np.linalg.norm(cars[:, :2], axis=1).min()
    assert np.hypot(*car[:2]) == pytest.approx(nearest)
