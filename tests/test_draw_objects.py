"""Objects cast into the scan of a model: boxes, labels and instances are exact."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bakes import plan_in
from small_models import SENSOR as SMALL, write
from typer.testing import CliRunner

from lidar_synth import (
    Bank,
    Boxes,
    MixedScans,
    ObjectBank,
    Scan,
    Town,
    layout_of,
    load_generator,
    open_scans,
)
from lidar_synth.bake import bake
from lidar_synth.cli import app
from lidar_synth.datasets.classes import GROUND, LABELS
from lidar_synth.errors import ConfigError, LibraryError
from lidar_synth.generate.generator import Generated
from lidar_synth.geometry.layout.files import NAMES, SIZES
from lidar_synth.geometry.layout.layout import CLASSES
from lidar_synth.lab.town.pasted import TownObjects
from lidar_synth.labels import draw_objects
from lidar_synth.labels.objects import THINGS

SENSOR = "hdl64e_lasers"


@pytest.fixture(scope="module")
def bank() -> TownObjects:
    made: TownObjects = ObjectBank.from_town(SENSOR, scans=3, seed=5)
    return made


@pytest.fixture(scope="module")
def street() -> Scan:
    return Town(9, SENSOR, 20)[4]


def known(street: Scan, bank: TownObjects) -> Boxes:
    assert street.boxes is not None
    have = [i for i, n in enumerate(street.boxes.names) if n in bank.boxes.names]
    return street.boxes[have]


def blurred(street: Scan) -> Scan:
    """The scan as a poor model draws it: objects spread by 0.5 m."""
    assert street.label is not None
    points = street.points.copy()
    mine = street.label < THINGS
    spread = np.random.default_rng(0).normal(0, 0.5, (mine.sum(), 3))
    points[mine] += spread.astype(np.float32)
    return replace(street, points=points, raw_label=None, instance=None)


def test_boxes_labels_and_instances_are_exact(bank: TownObjects, street: Scan) -> None:
    boxes = known(street, bank)
    drawn = draw_objects(blurred(street), boxes, bank)
    assert drawn.boxes is not None and drawn.label is not None
    assert drawn.instance is not None and len(drawn.boxes) >= 5
    assert len(np.unique(drawn.boxes.instance)) == len(drawn.boxes)
    inside = drawn.boxes.enlarged(0.15).contain(drawn.points)
    for number, instance in enumerate(drawn.boxes.instance):
        mine = drawn.instance == instance
        assert mine.any() and inside[number, mine].mean() > 0.99
    things = drawn.label < THINGS
    assert np.array_equal(things, drawn.instance > 0)
    cars = np.array(drawn.boxes.names) == "Car"
    of_cars = np.isin(drawn.instance, drawn.boxes.instance[cars])
    assert (drawn.label[of_cars] == LABELS["Car"]).all()
    rest = inside.any(0) & ~things
    assert GROUND[drawn.label[rest]].all()


def test_objects_have_the_returns_of_the_town(bank: TownObjects, street: Scan) -> None:
    """Drawn into the street that they were taken out of, they have about as many as before."""
    boxes = known(street, bank)
    drawn = draw_objects(blurred(street), boxes, bank)
    before = boxes.contain(street.points[street.label < THINGS]).sum(1)  # type: ignore[operator]
    after = boxes.contain(drawn.points[drawn.label < THINGS]).sum(1)  # type: ignore[operator]
    many = before >= 20
    assert many.sum() >= 4
    assert np.median(after[many] / before[many]) == pytest.approx(1, abs=0.25)
    assert np.array_equal(draw_objects(street, boxes, bank).points, drawn.points)


def test_a_street_without_boxes_loses_its_objects(
    bank: TownObjects, street: Scan
) -> None:
    drawn = draw_objects(street, known(street, bank)[[]], bank)
    assert drawn.boxes is not None and not len(drawn.boxes)
    assert drawn.label is not None and drawn.label.min() >= THINGS


def test_what_cannot_be_drawn_is_refused(bank: TownObjects, street: Scan) -> None:
    boxes = known(street, bank)[[0]]
    with pytest.raises(ConfigError, match=r"boxes of Zeppelin.*Car.*Leave"):
        draw_objects(street, replace(boxes, names=("Zeppelin",)), bank)
    returns = ObjectBank.from_scans(Town(5, SENSOR, 2))
    with pytest.raises(ConfigError, match="cannot be cast"):
        draw_objects(street, replace(boxes, names=(returns.boxes.names[0],)), returns)
    with pytest.raises(ConfigError, match="without labels"):
        draw_objects(replace(street, label=None, raw_label=None), boxes, bank)


def assert_exact(scan: Scan) -> None:
    """Each instance is in its box, has its class, and there is no other object."""
    assert scan.boxes is not None and scan.label is not None
    assert scan.instance is not None and len(scan.boxes)
    numbers = {0, *scan.boxes.instance.tolist()}
    assert set(np.unique(scan.instance).tolist()) == numbers
    assert np.array_equal(scan.label < THINGS, scan.instance > 0)
    inside = scan.boxes.enlarged(0.15).contain(scan.points)
    for number, instance in enumerate(scan.boxes.instance):
        assert inside[number, scan.instance == instance].mean() > 0.99


def test_a_generator_casts_the_objects_of_its_layouts(
    bank: TownObjects, street: Scan
) -> None:
    """Also boxes in which the model draws nothing get their returns, before they would be left
    out."""
    layout = layout_of(replace(street, boxes=known(street, bank)))
    model = load_generator("town-layout")
    [plain] = model.scans(0, [0], layout, steps=1)
    source = Generated(model, condition=[layout], objects=bank, steps=1)
    drawn = source[0]
    assert_exact(drawn)
    assert plain.boxes is not None and drawn.boxes is not None
    assert len(drawn.boxes) >= len(plain.boxes) >= 5
    lone = Generated(model, condition=[layout], steps=1)
    assert source.identity != lone.identity and source.fields == lone.fields
    smaller = replace(bank.boxes, values=0.9 * bank.boxes.values)
    other = Generated(
        model, condition=[layout], objects=bank.fit_sizes(smaller), steps=1
    )
    assert source.identity != other.identity
    mixed = MixedScans(None, source, 1.0, "boxes", epoch_size=1, compare=False)
    assert len(mixed[0]["boxes"]) == len(drawn.boxes)


def test_a_generator_refuses_objects_that_it_cannot_cast(
    bank: TownObjects, street: Scan
) -> None:
    model = load_generator("town-layout")
    returns = ObjectBank.from_scans(Town(5, SENSOR, 2))
    with pytest.raises(ConfigError, match=r"as objects for 'town-layout'.*from_town"):
        model.scans(0, [0], street, objects=returns)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match=r"as objects for 'town'"):
        load_generator("town").scans(0, [0], objects=bank)


def test_objects_of_a_model_without_layouts_are_refused(tmp_path: Path) -> None:
    plain = write(tmp_path / "plain.safetensors")
    with pytest.raises(ConfigError, match="a model of layouts"):
        plan_in(tmp_path / "bank", plain, objects="town")
    given = ["sample", str(tmp_path / "out"), "--model", str(plain)]
    result = CliRunner().invoke(app, [*given, "--objects", "town"])
    assert "a model of layouts" in str(result.exception)


def laid(folder: Path, text: str) -> tuple[Path, dict[str, Any]]:
    """A model of layouts, and the settings of a bake of one scan of a layout."""
    model = write(folder / "laid.safetensors", dropout=0.1, condition="layout")
    layout = folder / "street.yaml"
    layout.write_text(text)
    return model, {"condition": str(layout), "count": 1}


CAR = "objects: [{class: Car, at: [7, 2]}]"


def test_a_bank_of_drawn_objects_is_resumed_only_as_such(tmp_path: Path) -> None:
    model, given = laid(tmp_path, CAR)
    drawn = plan_in(tmp_path / "bank", model, objects="drawn", **given)
    bake(drawn, progress=False)
    with pytest.raises(ConfigError, match=r"'objects': 'drawn'.*'objects': 'town'"):
        bake(plan_in(tmp_path / "bank", model, **given), progress=False)
    bake(drawn, progress=False)


def test_a_folder_begun_without_an_option_refuses_it(tmp_path: Path) -> None:
    """Also where the option is left out at first: its scans would be of two kinds."""
    model, given = laid(tmp_path, CAR)
    out = tmp_path / "out"
    command = ["sample", str(out), "--model", str(model), "--count", "1"]
    command += ["--condition", given["condition"]]
    assert CliRunner().invoke(app, command).exit_code == 0
    refused = CliRunner().invoke(app, [*command, "--objects", "drawn"])
    assert "was filled with {'objects': 'town'}" in str(refused.exception)
    plain = ["sample", str(tmp_path / "plain"), "--count", "1", "--steps", "1"]
    assert CliRunner().invoke(app, plain).exit_code == 0
    refused = CliRunner().invoke(app, [*plain, "--columns", "1024"])
    assert "was filled with" in str(refused.exception)


def test_a_bank_and_a_folder_have_cast_objects(tmp_path: Path) -> None:
    """Of classes that the streets of the town lack, too."""
    model, given = laid(
        tmp_path,
        "objects: [{class: Car, at: [7, 2]}, {class: Motorcyclist, at: [-3, 3]},"
        " {class: Truck, at: [-9, 4], size: [9, 3, 3]}]",
    )
    bake(plan_in(tmp_path / "bank", model, **given), progress=False)
    baked = Bank(tmp_path / "bank")
    assert baked.index.sources[0].settings["objects"] == "town"
    assert '"objects": "town"' in (tmp_path / "bank" / "README.md").read_text()
    out = tmp_path / "out"
    command = ["sample", str(out), "--model", str(model), "--count", "1"]
    command += ["--condition", given["condition"], "--seed", "4"]
    assert CliRunner().invoke(app, command).exit_code == 0
    [sampled] = open_scans(out, sensor=SMALL)
    for scan in (baked[0], sampled):
        assert_exact(scan)
        assert scan.boxes is not None
        assert set(scan.boxes.names) == {"Car", "Motorcyclist", "Truck"}


def test_a_layout_without_objects_gets_a_scan_without_objects(tmp_path: Path) -> None:
    model, given = laid(tmp_path, "outlines: []")
    bake(plan_in(tmp_path / "bank", model, **given), progress=False)
    scan = Bank(tmp_path / "bank")[0]
    assert scan.boxes is not None and scan.label is not None
    assert len(scan) and not len(scan.boxes) and scan.label.min() >= THINGS


def test_without_embreex_the_error_names_the_way_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, given = laid(tmp_path, CAR)
    monkeypatch.setitem(sys.modules, "embreex.mesh_construction", None)
    with pytest.raises(LibraryError, match=r"pip install embreex.*--objects drawn"):
        plan_in(tmp_path / "bank", model, **given)
    bake(plan_in(tmp_path / "bank", model, objects="drawn", **given), progress=False)
    assert len(Bank(tmp_path / "bank")) == 1


def test_the_shapes_of_the_town_have_every_class_of_a_layout(street: Scan) -> None:
    """And what is cast in a box has the class of the box."""
    shapes = ObjectBank.from_town_shapes()
    assert set(shapes.boxes.names) == set(CLASSES)
    for name, size in SIZES.items():
        kind = NAMES.get(name, name)
        values = np.array([[15, 0, size[2] / 2 - 1.7, *size, 1]], np.float32)
        drawn = draw_objects(street[:0], Boxes(values, (kind,)), shapes)
        assert drawn.boxes is not None and drawn.boxes.names == (kind,)
        assert drawn.label is not None and len(drawn) > 20
        assert kind == "Misc" or set(drawn.label.tolist()) == {LABELS[kind]}
