"""The judge of objects: made cars of a known difference get a known answer."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from streets import SENSOR, street
from typer.testing import CliRunner

from lidar_synth import Boxes, Scan, open_scans
from lidar_synth.cli import app
from lidar_synth.errors import DataError
from lidar_synth.formats.npz import write_scan
from lidar_synth.lab.evaluate.objects import (
    Crop,
    as_text,
    compare_objects,
    crop,
    crops,
    match,
    separate,
)
from lidar_synth.labels.objects import Object

pytestmark = pytest.mark.usefixtures("one_thread")

PLACES = 4
EACH = 5


def blurred(scan: Scan, spread: float, seed: int) -> Scan:
    """The scan with noise along the rays."""
    noise = np.random.default_rng(seed).normal(0, spread, len(scan))
    far = np.linalg.norm(scan.points, axis=1)
    return replace(scan, points=scan.points * (1 + noise / far)[:, None].astype("f4"))


def write(root: Path, first: int, spread: float) -> Path:
    for number in range(PLACES * EACH):
        place = root / f"place{number // EACH}"
        place.mkdir(parents=True, exist_ok=True)
        scan = blurred(street(first + number), spread, first + number)
        write_scan(place / f"{number:03d}.npz", scan)
    return root


@pytest.fixture(scope="module")
def sets(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("sets")
    given = {"real": (0, 0.02), "alike": (100, 0.02), "rough": (200, 0.1)}
    return {name: write(root / name, *how) for name, how in given.items()}


def made(points: np.ndarray) -> Object:
    box = Boxes(np.array([[10, 0, 0, 4, 2, 2, 0]], np.float32), ("Car",))
    count = len(points)
    scan = Scan(
        points.astype(np.float32),
        np.zeros(count, np.float32),
        SENSOR,
        label=np.zeros(count, np.uint8),
        boxes=box,
    )
    return Object(scan, -1.7)


SURFACES = {
    "a roof": ((9, 11), (-0.8, 0.8), (-0.2, -0.2), (1, 0)),
    "a side": ((9, 9), (-0.8, 0.8), (-1.5, -0.2), (0, 1)),
}


@pytest.mark.parametrize("case", SURFACES)
@pytest.mark.parametrize("turn", [0, 2.5])
def test_surfaces_of_a_crop_are_told_apart(case: str, turn: float) -> None:
    *spans, shares = SURFACES[case]
    rng = np.random.default_rng(0)
    points = np.stack([rng.uniform(low, high, 200) for low, high in spans], 1)
    c = np.cos(turn)
    s = np.sin(turn)
    points[:, :2] = points[:, :2] @ np.array([[c, s], [-s, c]])
    found = crop(made(points), "here")
    assert (found.roof, found.side) == shares and found.returns == 200
    assert found.width == pytest.approx(1.55, abs=0.05)
    assert found.rough < 1e-4 and found.distance == pytest.approx(10, abs=1.1)
    rough = crop(made(points + rng.normal(0, 0.05, points.shape)), "here").rough
    assert rough == pytest.approx(0.03, abs=0.01)


def test_heights_of_a_crop_are_above_its_ground() -> None:
    rng = np.random.default_rng(0)
    points = np.stack([*rng.uniform(9, 11, (2, 200)), np.full(200, -0.2)], 1)
    assert crop(made(points), "").features["height"][-3:] == pytest.approx(1.5)


def seen(distance: float, width: float, name: str) -> Crop:
    return Crop(name, distance, width, 20, 0, 0, 0, {})


def test_only_similar_objects_are_paired_and_each_once() -> None:
    real = [seen(10, 2, "a"), seen(10.1, 2, "b"), seen(30, 4, "c"), seen(50, 2, "d")]
    fake = [seen(10.1, 2, "x"), seen(10.6, 2.1, "y"), seen(30, 2, "z")]
    pairs = {(one.place, other.place) for one, other in match(real, fake)}
    assert pairs == {("b", "x"), ("a", "y")}
    assert match(real, []) == []


def test_a_place_that_is_asked_about_is_never_seen() -> None:
    """A mark that tells the two sides apart at each place by another sign is of no use
    elsewhere."""
    rng = np.random.default_rng(0)

    def marked(place: str, value: float) -> Crop:
        mark = np.array([value, *rng.normal(size=3)])
        return Crop(place, 10, 2, 20, 0, 0, 0, {"mark": mark})

    odd = [
        (marked(f"p{i}", (-1) ** i), marked("", -((-1) ** i)))
        for i in range(4)
        for _ in range(20)
    ]
    area = separate(odd, ["mark"])
    assert area is not None and area < 0.6
    even = [(marked(f"p{i}", 1), marked("", -1)) for i in range(4) for _ in range(20)]
    assert separate(even, ["mark"]) == 1
    assert separate(even[:20], ["mark"]) is None  # one place


def test_the_place_of_second_objects_is_never_seen_either() -> None:
    """Their mark has one sign at c and the other at d, which only a classifier that has seen both
    can use."""
    a, b, c, d = (
        replace(seen(10, 2, place), features={"mark": np.array([float(value)])})
        for place, value in zip("abcd", (0, 0, 1, -1), strict=True)
    )
    assert separate([(a, c), (a, d), (b, c), (b, d)] * 5, ["mark"]) == 0


def test_cars_alike_cannot_be_told_and_rough_ones_can(sets: dict[str, Path]) -> None:
    real = open_scans(sets["real"])
    alike = compare_objects(real, open_scans(sets["alike"]))["car"]
    rough = compare_objects(real, open_scans(sets["rough"]))["car"]
    assert alike["places"] == rough["places"] == PLACES and alike["pairs"] >= 30
    assert 0.35 < alike["auc"] < 0.65 and 0.35 < alike["floor"] < 0.65
    assert max(rough["by"], key=lambda name: float(rough["by"][name])) == "roughness"
    assert rough["auc"] > 0.95 and rough["floor"] == alike["floor"]
    assert alike["returns"] == pytest.approx(1, abs=0.05)
    own, other = rough["rough"]
    assert other > 2 * own
    assert alike["side"][0] == pytest.approx(alike["side"][1], abs=0.05)


def test_the_command_prints_a_table(sets: dict[str, Path]) -> None:
    given = ["evaluate", str(sets["real"]), str(sets["rough"]), "--objects"]
    shown = CliRunner().invoke(app, given).output
    assert "| car |" in shown and "| person |" not in shown
    values = json.loads(CliRunner().invoke(app, [*given, "--json"]).output)
    assert f"| {values['car']['auc']:.2f} |" in shown
    twice = CliRunner().invoke(app, [*given, "--protocol", "town"])
    assert twice.exit_code == 2


def test_scans_of_one_folder_are_one_place(sets: dict[str, Path]) -> None:
    """Else the classifier would be asked about the objects that it has seen."""
    real = open_scans(sets["real"])
    flat = [replace(real[i], id=f"{i:06d}") for i in range(len(real))]
    figures = compare_objects(flat, open_scans(sets["rough"]))
    car = figures["car"]
    assert (car["places"], car["auc"], car["floor"]) == (1, None, None)
    assert "needs two places with 4 objects" in as_text(figures)


def test_instances_without_boxes_are_judged_too(sets: dict[str, Path]) -> None:
    scans = [open_scans(sets["real"])[i] for i in range(4)]
    boxed = crops(scans, "car")
    bare = crops([replace(scan, boxes=None) for scan in scans], "car")
    assert {c.returns for c in bare} == {c.returns for c in boxed}


def test_sets_without_common_objects_are_refused(sets: dict[str, Path]) -> None:
    real = open_scans(sets["real"])
    empty = [replace(real[0], boxes=Boxes(np.zeros((0, 7), np.float32), ()))]
    with pytest.raises(DataError, match="no two similar objects"):
        compare_objects(real, empty)
