"""A model of layouts from its condition to a trainer: boxes and instances through scans, banks and
mixtures."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from bakes import COUNT, files, plan_in
from small_models import SENSOR, write
from test_conditions import conditioned_batches
from torch.utils.data import DataLoader
from typer.testing import CliRunner

from lidar_synth import (
    Bank,
    Generator,
    Layout,
    MixedScans,
    load_generator,
    load_layout,
    make_policy,
)
from lidar_synth.bake import bake
from lidar_synth.bake.conditions import LayoutFiles
from lidar_synth.bake.edit import head, merge, split
from lidar_synth.bake.repair import repair
from lidar_synth.bake.verify import regenerate, verify
from lidar_synth.bank import BOXED_FORMAT, FORMAT, Encoding
from lidar_synth.bank.boxes import SHAPE, check_boxes, decode_boxes, encode_boxes
from lidar_synth.cli import app
from lidar_synth.datasets.classes import TRAIN_ID
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.generate.boxed import add_boxes
from lidar_synth.generate.conditions import CONDITIONS, batch_of
from lidar_synth.generate.generator import Generated
from lidar_synth.geometry.layout import CODES, Outline, layout_image
from lidar_synth.geometry.layout.raster import depth_of
from lidar_synth.geometry.projection import unproject
from lidar_synth.geometry.scan import Boxes, RangeImage
from lidar_synth.labels import ObjectBank

pytestmark = pytest.mark.usefixtures("one_thread")

LAYOUTS = {
    "one": (
        "objects: [{class: Truck, at: [14, 2], size: [16, 10, 6], above: -1}, "
        "{class: Car, at: [-9, 3]}]"
    ),
    "two": "objects: [{class: Tram, at: [3, 16], size: [40, 12, 8], above: -2, heading: 20}]",
    "none": "ground: -1.6",
}


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(
        tmp_path_factory.mktemp("model") / "laid.safetensors",
        dropout=0.1,
        condition="layout",
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("layouts")
    for name, text in LAYOUTS.items():
        (folder / f"{name}.yaml").write_text(text)
    return folder


@pytest.fixture(scope="module")
def bank(model: Path, folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("bank") / "bank"
    bake(plan_in(out, model, condition=str(folder)), progress=False)
    return out


def generated(model: Path, folder: Path) -> tuple[Generator, list[Layout]]:
    layouts = LayoutFiles(folder)
    return load_generator(model), [layouts.read(i) for i in range(len(layouts))]


def test_the_boxes_of_a_scan_are_those_of_its_layout_that_hold_points(
    model: Path, folder: Path
) -> None:
    generator, layouts = generated(model, folder)
    assert generator.fields >= {"boxes", "instance"} and generator.condition == "layout"
    found = 0
    for index, (layout, scan) in enumerate(
        zip(layouts, generator.scans(0, [0, 1, 2], layouts), strict=True)
    ):
        assert (
            scan.boxes is not None
            and scan.instance is not None
            and scan.label is not None
        )
        wide = replace(
            layout.boxes,
            values=layout.boxes.values + np.float32([0, 0, 0, 0.2, 0.2, 0.2, 0]),
        )
        inside = wide.contain(scan.points) & ~np.isin(scan.label, [8, 9, 10, 11, 16])
        held = inside.any(1)
        assert scan.boxes.names == tuple(
            n for n, h in zip(layout.boxes.names, held, strict=True) if h
        ), index
        assert np.array_equal(scan.boxes.values, layout.boxes.values[held])
        assert np.array_equal(scan.boxes.instance, np.arange(1, held.sum() + 1))
        assert np.array_equal(scan.instance > 0, inside.any(0))
        found += len(scan.boxes)
    assert found >= 2


def test_a_crossing_has_no_streaks_of_bicycles(tmp_path: Path) -> None:
    """All that moves stands in the boxes of a layout, and has their class: also cycles, of which it
    says nothing."""
    places = ((8, -3), (8, -1), (8.5, 1), (9, 3), (10, 0), (10, -2))
    people = "".join(f"  - {{class: Pedestrian, at: [{x}, {y}]}}\n" for x, y in places)
    (tmp_path / "crossing.yaml").write_text("objects:\n" + people)
    [scan] = load_generator("town-layout").scans(
        0, [0], load_layout(tmp_path / "crossing.yaml")
    )
    assert (
        scan.boxes is not None
        and scan.label is not None
        and len(scan.boxes) == len(places)
    )
    moving = scan.label <= TRAIN_ID["motorcyclist"]
    assert moving.sum() > 1000 and (scan.label[moving] == TRAIN_ID["person"]).all()
    assert scan.boxes.enlarged(0.1).contain(scan.points[moving]).any(0).all()


def test_an_image_of_a_layout_tells_no_boxes_and_other_conditions_are_refused(
    model: Path, folder: Path
) -> None:
    generator, layouts = generated(model, folder)
    image = layout_image(layouts[0], SENSOR)
    [scan], [same] = generator.scans(0, [0], image), generator.scans(0, [0], layouts[0])
    assert scan.boxes is None and same.boxes is not None
    assert np.array_equal(scan.points, same.points)  # the condition is the image
    with pytest.raises(DataError, match="codes"):
        generator.scans(0, [0], np.full_like(image, 200))
    with pytest.raises(DataError, match="shape"):
        generator.scans(0, [0], image[:, :4])
    with pytest.raises(DataError, match="layouts and images of layouts together"):
        generator.scans(0, [0, 1], [layouts[0], image])
    with pytest.raises(ConfigError, match="a Scan, or a list of them"):
        load_generator("town-semantic").scans(0, [0], layouts[0])


def test_a_layout_of_another_sensor_or_out_of_range_is_refused(model: Path) -> None:
    far = Layout(Boxes(np.float32([[99, 0, -1, 4, 2, 1.5, 0]]), ("Car",)))
    tall = Layout(Boxes(np.zeros((0, 7), np.float32), ()), (-2.4, 0.0, 0.0), id="lorry")
    shape = (5, *SENSOR.shape)
    options = {"height": 1.73}
    with pytest.raises(
        DataError,
        match=r"box 0 at 99\.0 m; expected boxes within the sensor's range of 80 m",
    ):
        batch_of("layout", far, 1, SENSOR, shape, options)
    with pytest.raises(
        DataError,
        match=r"layout 'lorry' of a sensor 2\.40 m above the ground; expected 1\.73 m",
    ):
        batch_of("layout", tall, 1, SENSOR, shape, options)


def test_a_reduced_condition_knows_boxes_and_the_ground_nearby_alone() -> None:
    wall = Outline("building", np.float32([(-50, 8), (50, 8)]), -1.7, 5)
    layout = Layout(
        Boxes(np.float32([[12, 0, -1, 4, 2, 1.5, 0]]), ("Car",)),
        outlines=[wall],
        reach=70,
    )
    image = layout_image(layout, replace(SENSOR, columns=256, rows=32))
    values = torch.from_numpy(image).expand(3, *image.shape)
    less = (
        CONDITIONS["layout"].reduced(values, torch.tensor([0.0, 0.5, 1.0]), 1).numpy()
    )
    for one, reach in zip(less, (5, 20, 80), strict=True):
        kept = (image[0] >= CODES["Car"]) | (
            (image[0] == CODES["ground"]) & (depth_of(image) < reach)
        )
        assert np.array_equal(one, np.where(kept, image, 0))
    assert (less[0, 0] > 0).sum() < (less[1, 0] > 0).sum() < (less[2, 0] > 0).sum()


def test_a_bank_keeps_boxes_and_instances(
    bank: Path, model: Path, folder: Path
) -> None:
    opened, (generator, layouts) = Bank(bank), generated(model, folder)
    assert opened.index.sources[0].format == BOXED_FORMAT and opened.fields >= {
        "boxes",
        "instance",
    }
    assert [opened.condition(i) for i in range(4)] == ["none", "one", "two", "none"]
    assert (
        not verify(bank, progress=False)
        and min(regenerate(bank, str(model), progress=False).values()) > 0.9
    )
    shapes = ObjectBank.from_town_shapes()
    for number in range(COUNT):
        scan, [made] = (
            opened[number],
            generator.scans(4, [number], [layouts[number % 3]], objects=shapes),
        )
        assert scan.boxes is not None and made.boxes is not None
        assert scan.boxes.names == made.boxes.names and np.array_equal(
            scan.instance, made.instance
        )  # type: ignore[arg-type]
        assert np.abs(scan.boxes.values - made.boxes.values).max(initial=0) < 1e-4
    assert any(len(opened[i].boxes) for i in range(COUNT))  # type: ignore[arg-type]


def test_banks_with_boxes_are_split_merged_and_repaired(
    bank: Path, model: Path, tmp_path: Path
) -> None:
    opened = Bank(bank)
    split(opened, {tmp_path / "a": 0.5, tmp_path / "b": 0.5}, progress=False)
    merge(
        [Bank(tmp_path / "a"), Bank(tmp_path / "b")], tmp_path / "both", progress=False
    )
    head(opened, 4, tmp_path / "head", progress=False)
    for name, count in (("both", COUNT), ("head", 4)):
        again = Bank(tmp_path / name)
        assert not verify(tmp_path / name, progress=False) and len(again) == count
        for i in range(count):
            assert again[i].boxes.names == opened[i].boxes.names  # type: ignore[union-attr]
            values = again[i].boxes.values, opened[i].boxes.values  # type: ignore[union-attr]
            assert np.array_equal(*values)
    before = files(tmp_path / "both")
    damaged = tmp_path / "both" / "shard-00000.h5"
    content = damaged.read_bytes()
    damaged.unlink()  # a link to the shard of the first bank
    damaged.write_bytes(content[:-100])
    assert verify(tmp_path / "both", progress=False)
    repair(tmp_path / "both", str(model), progress=False)
    assert files(tmp_path / "both") == before
    plain = write(tmp_path / "plain.safetensors")
    bake(plan_in(tmp_path / "plain", plain), progress=False)
    assert Bank(tmp_path / "plain").index.sources[0].format == FORMAT
    with pytest.raises(ConfigError, match="holds"):
        merge([opened, Bank(tmp_path / "plain")], tmp_path / "mixed", progress=False)


def test_changed_layouts_are_refused_when_a_bake_resumes_or_is_repaired(
    model: Path, folder: Path, tmp_path: Path
) -> None:
    own = tmp_path / "layouts"
    shutil.copytree(folder, own)
    bake(plan_in(tmp_path / "bank", model, condition=str(own)), progress=False)
    (tmp_path / "bank" / "shard-00000.h5").unlink()
    (own / "one.yaml").write_text(LAYOUTS["two"])
    with pytest.raises(
        ConfigError, match="which have moved or changed since the bank was begun"
    ):
        repair(tmp_path / "bank", str(model), progress=False)
    with pytest.raises(ConfigError, match="was filled with .*condition_content"):
        bake(plan_in(tmp_path / "bank", model, condition=str(own)), progress=False)
    (own / "one.yaml").write_text(LAYOUTS["one"])
    assert repair(tmp_path / "bank", str(model), progress=False) == {
        "shard-00000.h5": "regenerated"
    }


def test_layouts_that_are_added_or_removed_between_two_bakes_are_noticed(
    model: Path, folder: Path, tmp_path: Path
) -> None:
    own = Path(shutil.copytree(folder, tmp_path / "layouts"))
    bake(plan_in(tmp_path / "three", model, condition=str(own)), progress=False)
    shutil.copy(own / "one.yaml", own / "a.yaml")
    bake(plan_in(tmp_path / "four", model, condition=str(own)), progress=False)
    assert [Bank(tmp_path / "four").condition(i) for i in (0, 4)] == ["a", "a"]
    (tmp_path / "three" / "shard-00000.h5").unlink()
    away = own.rename(tmp_path / "away")
    with pytest.raises(ConfigError, match="moved or changed since .*--condition"):
        repair(tmp_path / "three", str(model), progress=False)
    (away.rename(own) / "a.yaml").unlink()
    assert repair(tmp_path / "three", str(model), progress=False) == {
        "shard-00000.h5": "regenerated"
    }


def test_a_folder_of_layouts_holds_nothing_else_that_is_visible(
    model: Path, folder: Path, tmp_path: Path
) -> None:
    own = Path(shutil.copytree(folder, tmp_path / "layouts"))
    (own / ".ipynb_checkpoints").mkdir()
    (own / "._one.yaml").write_bytes(b"\0\5\x16\7")
    contents = {
        plan_in(tmp_path / "bank", model, condition=str(f)).settings[
            "condition_content"
        ]
        for f in (folder, own)
    }
    assert len(contents) == 1
    (own / "README.md").touch()
    with pytest.raises(DataError, match=r"holds layouts and README\.md"):
        plan_in(tmp_path / "bank", model, condition=str(own))


def test_a_detector_gets_boxes_from_the_bank_and_from_the_generator(
    bank: Path, model: Path, folder: Path
) -> None:
    generator, layouts = generated(model, folder)
    for source in (Bank(bank), Generated(generator, seed=4, condition=layouts)):
        mixed = MixedScans(
            None,
            source,
            1.0,
            labels="boxes",
            epoch_size=6,
            unboxed="keep",
            compare=False,
        )
        batches = list(DataLoader(mixed, batch_size=3, collate_fn=mixed.collate))
        assert sum(len(batch["boxes"]) for batch in batches) > 0
        assert {
            name for batch in batches for names in batch["names"] for name in names
        } <= {
            "Truck",
            "Car",
            "Tram",
        }


def test_a_bank_without_boxes_is_refused_for_a_detector(tmp_path: Path) -> None:
    bake(
        plan_in(tmp_path / "plain", write(tmp_path / "plain.safetensors")),
        progress=False,
    )
    with pytest.raises(ConfigError, match="labels='boxes', but besides points"):
        make_policy("boxes", fields=Bank(tmp_path / "plain").fields)


def test_the_command_line_takes_a_layout(
    model: Path, folder: Path, tmp_path: Path
) -> None:
    def call(*words: Any) -> Any:
        return CliRunner().invoke(
            app, [str(word) for word in words], catch_exceptions=True
        )

    done = call(
        "sample",
        tmp_path / "out",
        "--model",
        model,
        "--count",
        2,
        "--condition",
        folder / "two.yaml",
    )
    assert done.exit_code == 0, done.output
    from lidar_synth import open_scans

    assert open_scans(tmp_path / "out")[0].boxes.names == ("Tram",)  # type: ignore[union-attr]
    semantic = write(tmp_path / "semantic.safetensors", dropout=0.1)
    refused = call(
        "sample",
        tmp_path / "no",
        "--model",
        semantic,
        "--condition",
        folder / "two.yaml",
    )
    assert refused.exit_code == 1 and "layouts for model 'semantic'" in str(
        refused.exception or refused.output
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("objects: [{class: Dragon, at: [9, 0]}]", "Dragon"),
        ("objects: [{class: Car, at: [900, 0]}]", "within the sensor's range"),
    ],
)
def test_a_bad_layout_of_a_folder_stops_a_run_before_it_begins(
    text: str, message: str, model: Path, tmp_path: Path
) -> None:
    given = tmp_path / "layouts"
    given.mkdir()
    (given / "a.yaml").write_text(LAYOUTS["two"])
    (given / "b.yaml").write_text(text)
    words = ["sample", str(tmp_path / "out"), "--model", str(model), "--count", "2"]
    words += ["--condition", str(given), "--objects", "drawn"]
    with pytest.raises((ConfigError, DataError), match=message):
        CliRunner().invoke(app, words, catch_exceptions=False)
    (given / "b.yaml").write_text(LAYOUTS["none"])
    assert CliRunner().invoke(app, words).exit_code == 0


def test_rows_of_boxes_are_encoded_and_refused() -> None:
    rng = np.random.default_rng(0)
    values = rng.uniform(
        (-80, -80, -3, 0.1, 0.1, 0.1, -np.pi), (80, 80, 3, 30, 4, 5, np.pi), (50, 7)
    ).astype(np.float32)
    values[0, 3:6] = 4.5e-5  # less than half a step: it becomes a whole one
    boxes = Boxes(
        values, ("Cyclist", "Car") * 25, instance=np.arange(1, 51, dtype=np.int32)
    )
    rows = encode_boxes(boxes)
    again = decode_boxes(rows)
    assert (
        rows.shape == SHAPE
        and again.names == boxes.names
        and np.array_equal(again.instance, boxes.instance)
    )
    assert np.abs(again.values - values).max() < 6e-5
    assert np.array_equal(encode_boxes(again), rows)
    check_boxes(rows)
    for place, value in (
        ((3, 0), 77),
        ((3, 0), 0),
        ((3, 1), 0),
        ((3, 6), -5),
        ((200, 4), 1),
        ((60, 0), -1),
    ):
        wrong = rows.copy()
        wrong[place] = value
        with pytest.raises(DataError, match="boxes with"):
            check_boxes(wrong)
    for bad in (
        replace(boxes, instance=boxes.instance - 1),
        replace(boxes, names=("Dragon",) * 50),
    ):
        with pytest.raises(DataError, match="boxes"):
            encode_boxes(bad)
    image = RangeImage(
        np.zeros(SENSOR.shape, np.float32),
        SENSOR,
        {"instance": np.zeros(SENSOR.shape, np.int32)},
    )
    with pytest.raises(DataError, match=r"without \['boxes'\]"):
        Encoding(SENSOR, {"instance", "boxes"}).encode(image)


def test_ground_in_a_box_belongs_to_no_object() -> None:
    distance = np.full(SENSOR.shape, 10, np.float32)
    label = (
        np.where(np.arange(SENSOR.columns) % 2, 0, 8)[None]
        .repeat(SENSOR.shape[0], 0)
        .astype(np.uint8)
    )
    image = RangeImage(distance, SENSOR, {"label": label})
    made = add_boxes(
        image,
        Boxes(
            np.float32([[10, 0, 0, 4, 4, 4, 0], [-30, 0, 0, 1, 1, 1, 0]]),
            ("Car", "Car"),
        ),
    )
    scan = unproject(made)
    assert scan.boxes is not None and len(scan.boxes) == 1 and scan.instance is not None
    assert (scan.instance > 0).any()
    assert (scan.label[scan.instance > 0] == 0).all()  # type: ignore[index]


def test_a_reduced_layout_keeps_its_boxes_and_stays_with_its_scan(
    tmp_path: Path,
) -> None:
    plain, less = (
        conditioned_batches(tmp_path, "layout", reduction=r, flip=True, roll=True)
        for r in (0.0, 0.5)
    )
    a = plain(range(60)).cond
    b = less(range(60)).cond
    assert a is not None and b is not None
    boxed = a[:, 0] > 4
    assert boxed.any() and torch.equal(boxed, b[:, 0] > 4)
    changed = (a != b).flatten(1).any(1)
    assert 15 <= int(changed.sum()) <= 45
    assert (b[changed] <= a[changed]).all()
