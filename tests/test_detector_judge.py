"""Released detectors as judges of scans with boxes."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from random_detectors import random_points, random_state
from safetensors.numpy import load_file
from typer.testing import CliRunner

from lidar_synth import Boxes, Scan
from lidar_synth.cli import app
from lidar_synth.errors import DataError, FileError
from lidar_synth.formats.npz import write_scan
from lidar_synth.geometry.sensor import presets
from lidar_synth.lab.proof.detection.bev import Found
from lidar_synth.lab.proof.detection.centerpoint import CenterPoint, decode_centres
from lidar_synth.lab.proof.detection.detector_judge import (
    Detecting,
    as_text,
    load_detector,
    recognise_boxes,
)
from lidar_synth.lab.proof.detection.pillars import suppress
from lidar_synth.lab.proof.detection.pointpillars import PointPillars

SENSOR = presets()["town"]
GOLDEN = Path(__file__).parent / "golden" / "openpcdet_pointpillars.safetensors"


def released(
    path: Path, network: Detecting | None = None, **changes: torch.Tensor
) -> Path:
    """A checkpoint with random weights, as OpenPCDet writes it."""
    state = random_state((network or PointPillars()).state_dict()) | changes
    state["global_step"] = torch.zeros(1, dtype=torch.int64)
    torch.save({"epoch": 80, "it": 1, "model_state": state, "version": "0.1.0"}, path)
    return path


def comparable(boxes: torch.Tensor, scores: torch.Tensor, classes: torch.Tensor) -> Any:
    """(D, 10) boxes without a jump at half a turn, scores and classes."""
    yaw = boxes[:, 6]
    columns = [*boxes.T[:6], yaw.cos(), yaw.sin(), scores, classes]
    return torch.stack([column.double() for column in columns], 1)


def scan_of(*boxes: tuple[float, ...], names: tuple[str, ...]) -> Scan:
    """A scan with 40 returns in each box."""
    rng = np.random.default_rng(0)
    values = np.array(boxes, np.float32)
    points = values[:, None, :3] + rng.uniform(-0.3, 0.3, (len(boxes), 40, 3))
    points = points.reshape(-1, 3).astype(np.float32)
    ones = np.ones(len(points), np.float32)
    return Scan(points, ones, SENSOR, boxes=Boxes(values, names))


def test_network_agrees_with_openpcdet(tmp_path: Path) -> None:
    network = load_detector(released(tmp_path / "pointpillar_7728.pth"))
    with torch.inference_mode():
        logits, boxes = network(torch.from_numpy(random_points()))
    golden = load_file(GOLDEN)
    index = golden["index"]
    assert np.allclose(logits[index], golden["logits"], rtol=1e-4, atol=1e-4)
    assert np.allclose(boxes[index], golden["boxes"], rtol=1e-4, atol=1e-4)


def test_centerpoint_agrees_with_openpcdet(tmp_path: Path) -> None:
    """The 100 best boxes of each head."""
    network = load_detector(released(tmp_path / "centerpoint.pth", CenterPoint()))
    points = np.column_stack([random_points(), np.zeros(6000, np.float32)])
    points[:, :3] -= (30, 0, 0)
    with torch.inference_mode():
        heads = network(torch.from_numpy(points))
    golden = load_file(GOLDEN.with_name("openpcdet_centerpoint.safetensors"))
    for number, found in enumerate(heads):
        own = comparable(*found)
        names = ("boxes", "scores", "classes")
        expected = comparable(
            *(torch.from_numpy(golden[f"{number}.{name}"]) for name in names)
        )
        # In any order: scores of random weights differ by less than machines do.
        assert torch.cdist(expected, own).min(1).values.max() < 1e-3


def test_centres_are_decoded_in_the_frame_of_the_scan(tmp_path: Path) -> None:
    """A car 10 m in front of the sensor, which nuScenes calls y, that points to the left."""
    network = load_detector(released(tmp_path / "weights.pth", CenterPoint()))
    maps = {
        name: torch.zeros(n, 128, 128)
        for name, n in {
            "center": 2,
            "center_z": 1,
            "dim": 3,
            "rot": 2,
            "vel": 2,
        }.items()
    }
    maps["hm"] = torch.full((1, 128, 128), -9.0)
    maps["hm"][0, 76, 64] = 5
    maps["center"][1] = 0.5
    maps["rot"][0] = -1
    centres = decode_centres(maps)
    none = torch.zeros(0, 7), torch.zeros(0), torch.zeros(0)
    network.forward = lambda _: [centres, *[none] * 5]  # type: ignore[method-assign]
    found = network.find(scan_of((10, 0, -1, 4, 1.8, 1.5, 0), names=("Car",)))
    expected = [[10, 0, 0, 1, 1, 1, np.pi / 2]]
    assert np.allclose(found.boxes, expected, atol=1e-5)
    assert found.classes.tolist() == [0]


def test_overlapping_boxes_are_suppressed() -> None:
    boxes = np.array(
        [
            [10, 0, 0, 4, 2, 1.5, 0],
            [10.5, 0.2, 0, 4, 2, 1.5, 0.1],
            [10, 1.9, 0, 4, 2, 1.5, 0],
            [30, 0, 0, 4, 2, 1.5, 1],
        ],
        np.float32,
    )
    scores = np.array([0.5, 0.9, 0.4, 0.7], np.float32)
    assert suppress(boxes, scores, 0.01, 4096, 500) == [1, 3]
    assert suppress(boxes[:0], scores[:0], 0.01, 4096, 500) == []


def test_boxes_are_found_in_front_only(tmp_path: Path) -> None:
    network = load_detector(released(tmp_path / "weights.pth"))
    points = random_points()
    found = network.find(Scan(points[:, :3], points[:, 3], SENSOR))
    assert len(found.boxes) and network.sees(found.boxes).all()
    assert ((found.scores >= 0.1) & (found.scores <= 1)).all()
    assert (np.diff(found.scores) <= 0).all()


def test_figures_by_class_and_distance(monkeypatch: pytest.MonkeyPatch) -> None:
    """A detector that finds one of two cars, and two boxes that do not count."""
    near = (10, 0, -1, 4, 1.8, 1.5, 0)
    far = (40, 5, -1, 4, 1.8, 1.5, 0)
    behind = (-10, 0, -1, 4, 1.8, 1.5, 0)
    van = (25, 0, -1, 5, 2, 2, 0)
    walker = (15, 3, -1, 0.8, 0.6, 1.7, 0)
    names = ("Car", "Car", "Car", "Van", "Pedestrian")
    scan = scan_of(near, far, behind, van, walker, names=names)
    found = Found(
        np.array([near, van], np.float32),
        np.array([0.9, 0.8], np.float32),
        np.zeros(2, np.int64),
    )
    monkeypatch.setattr(PointPillars, "find", lambda *_: found)
    figures = recognise_boxes(PointPillars(), [scan], progress=False)
    cars = figures["classes"]["car"]
    assert cars["all"] == {"boxes": 2, "precision": 0.5, "recall": 0.5}
    assert cars["0 to 20 m"] == {"boxes": 1, "precision": 1, "recall": 1}
    assert cars["over 35 m"]["recall"] == 0
    assert "20 to 35 m" not in cars
    assert figures["classes"]["pedestrian"]["all"]["precision"] == 0
    text = as_text({"real": figures, "fake": {"scans": 2, "classes": {}}})
    assert "| car | all | 2 | 50.0 | 50.0 | 0 | |" in text


def test_bad_checkpoints_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="OpenPCDet"):
        load_detector(tmp_path / "missing.pth")
    torch.save({"state_dict": {}}, tmp_path / "other.pth")
    with pytest.raises(DataError, match="model_state"):
        load_detector(tmp_path / "other.pth")
    wrong = released(
        tmp_path / "wrong.pth",
        **{"dense_head.conv_cls.weight": torch.zeros(2, 384, 1, 1)},
    )
    with pytest.raises(DataError, match="conv_cls"):
        load_detector(wrong)


def test_scans_without_boxes_in_front_are_refused() -> None:
    behind = scan_of((-10, 0, -1, 4, 1.8, 1.5, 0), names=("Car",))
    network = PointPillars().eval()
    with pytest.raises(DataError, match="where the detector looks"):
        recognise_boxes(network, [behind], progress=False)
    with pytest.raises(DataError, match="without boxes"):
        bare = Scan(behind.points, behind.reflectance, SENSOR)
        recognise_boxes(network, [bare], progress=False)


@pytest.mark.slow
def test_the_command_prints_a_table(tmp_path: Path) -> None:
    weights = released(tmp_path / "weights.pth")
    scan = scan_of((10, 0, -1, 4, 1.8, 1.5, 0), names=("Car",))
    for name in ("real", "fake"):
        (tmp_path / name).mkdir()
        write_scan(tmp_path / name / "0.npz", scan)
    given = [
        *("evaluate", str(tmp_path / "real"), str(tmp_path / "fake")),
        *("--detector", str(weights)),
    ]
    shown = CliRunner().invoke(app, given).output
    assert "| car | 0 to 20 m | 1 |" in shown
    values = json.loads(CliRunner().invoke(app, [*given, "--json"]).output)
    assert values["fake"]["classes"]["car"]["all"]["boxes"] == 1
    assert CliRunner().invoke(app, [*given, "--objects"]).exit_code == 2
