"""Evaluation by a network that was trained on real streets: an archive in lidar-bonnetal's
layout."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from conftest import _folder, random_scan
from typer.testing import CliRunner

from lidar_synth import open_scans
from lidar_synth.cli import app
from lidar_synth.datasets.classes import IGNORE, SEMANTIC_KITTI
from lidar_synth.errors import ConfigError, DataError, FileError, LidarSynthError
from lidar_synth.geometry.projection import project
from lidar_synth.geometry.sensor import presets
from lidar_synth.lab.evaluate.extractors.bonnetal import PARTS
from lidar_synth.lab.evaluate.extractors.squeezeseg import SqueezeSeg
from lidar_synth.lab.evaluate.recognition import (
    Recognition,
    as_text,
    compare,
    recognise,
)
from lidar_synth.lab.evaluate.street_judge import StreetJudge, load_archive

RAW = [0, 10, 11, 15, 18, 20, 30, 31, 32, 40, 44, 48, 49, 50, 51, 70, 71, 72, 80, 81]
ARCHITECTURE = {
    "backbone": {
        "name": "squeezeseg",
        "input_depth": {"range": True, "xyz": True, "remission": True},
    },
    "decoder": {"name": "squeezeseg"},
    "head": {"name": "segmentation"},
    "dataset": {
        "sensor": {
            "name": "HDL64",
            "fov_up": 3,
            "fov_down": -25,
            "img_prop": {"width": 2048, "height": 64},
            "img_means": [12.12, 10.88, 0.23, -1.04, 0.21],
            "img_stds": [12.32, 11.47, 6.91, 0.86, 0.16],
        }
    },
}


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    """An archive with random weights."""
    torch.manual_seed(0)
    folder = tmp_path / "archive"
    folder.mkdir()
    network = SqueezeSeg()
    for part in PARTS:
        torch.save(network.get_submodule(part).state_dict(), folder / part)
    (folder / "arch_cfg.yaml").write_text(yaml.safe_dump(ARCHITECTURE))
    (folder / "data_cfg.yaml").write_text(
        yaml.safe_dump({"learning_map_inv": dict(enumerate(RAW))})
    )
    return folder


def change(archive: Path, edit: Callable[[dict], object]) -> None:  # type: ignore[type-arg]
    settings = yaml.safe_load((archive / "arch_cfg.yaml").read_text())
    edit(settings)
    (archive / "arch_cfg.yaml").write_text(yaml.safe_dump(settings))


def test_the_input_of_the_network_is_the_nearest_point_of_each_cell(
    archive: Path,
) -> None:
    judge = load_archive(archive, columns=1024)
    scan = random_scan(presets()["town"], 4000, seed=1)
    image, label = judge.image(scan)
    expected = project(scan, judge.segmenter.sensor, ["reflectance", "label"])
    values = (
        image * judge.segmenter.deviation[:, None, None]
        + judge.segmenter.mean[:, None, None]
    )
    filled = expected.mask
    assert image.shape == (5, 64, 1024) and (image[:, ~filled] == 0).all()
    np.testing.assert_allclose(values[0, filled], expected.range[filled], rtol=1e-4)
    np.testing.assert_allclose(
        values[4, filled], expected.channels["reflectance"][filled], atol=1e-4
    )
    np.testing.assert_allclose(
        (values[1:4] ** 2).sum(0).sqrt()[filled], expected.range[filled], rtol=1e-4
    )
    assert (label == np.where(filled, expected.channels["label"], IGNORE)).all()


def test_predictions_are_counted_by_train_id_and_never_as_unlabelled(
    archive: Path,
) -> None:
    judge = load_archive(archive, columns=64)
    scan = random_scan(presets()["town"], 2000, seed=2)
    for chosen in (
        0,
        9,
        17,
    ):  # the head predicts one class everywhere: unlabelled, road, terrain
        with torch.no_grad():
            judge.segmenter.network.segmentation_head[1].weight.zero_()
            judge.segmenter.network.segmentation_head[1].bias.copy_(
                torch.arange(20) / 100 + 9 * (torch.arange(20) == chosen)
            )
        table = judge.confusion([scan])
        _, label = judge.image(scan)
        column = int(SEMANTIC_KITTI.decode(np.array([RAW[chosen or 19]]))[0])
        assert (table.sum(1) == np.bincount(label[label != IGNORE], minlength=19)).all()
        assert table[:, column].sum() == table.sum()


def test_recognition_by_hand() -> None:
    table = np.zeros((19, 19), np.int64)
    table[0, 0] = 6
    table[0, 12] = 2
    table[8, 8] = 3
    table[8, 9] = 1
    table[8, 10] = 2
    isolated = np.zeros((2, 20), np.int64)
    isolated[:, 8] = 1, 4
    found = Recognition(table, np.zeros((2, 3)), isolated)
    assert found.accuracy == 9 / 14 and found.iou() == {"car": 6 / 8, "road": 3 / 6}
    assert found.confusions("road") == [("sidewalk", 2 / 6), ("parking", 1 / 6)]
    other = replace(found, features=np.random.default_rng(0).normal(size=(5, 3)))
    text = as_text(compare(other, other))
    assert (
        "| road | 50.0 | 50.0 | sidewalk 33, parking 17 | 25.0 | 25.0 |" in text
        and "| accuracy | 64.3 | 64.3 | |" in text
    )


FAULTS: dict[str, tuple[Callable[[Path], object], type[LidarSynthError], str]] = {
    "code": (
        lambda a: torch.save({"a": print}, a / "backbone"),
        DataError,
        "not tensors by name",
    ),
    "truncated": (
        lambda a: (a / "backbone").write_bytes((a / "backbone").read_bytes()[:9000]),
        DataError,
        "backbone",
    ),
    "missing": (
        lambda a: (a / "segmentation_head").unlink(),
        FileError,
        "segmentation_head",
    ),
    "other weights": (
        lambda a: torch.save(
            torch.nn.Linear(2, 2).state_dict(), a / "segmentation_head"
        ),
        DataError,
        "architecture",
    ),
    "a list": (
        lambda a: torch.save([1], a / "segmentation_head"),
        DataError,
        "segmentation_head: its weights",
    ),
    "another network": (
        lambda a: change(a, lambda s: s["backbone"].update(name="darknet")),
        ConfigError,
        "darknet.*squeezeseg",
    ),
    "no sensor": (
        lambda a: change(a, lambda s: s["dataset"].pop("sensor")),
        ConfigError,
        "sensor",
    ),
    "other input": (
        lambda a: change(
            a, lambda s: s["backbone"]["input_depth"].update(remission=False)
        ),
        DataError,
        "architecture",
    ),
    "text as a mean": (
        lambda a: change(
            a, lambda s: s["dataset"]["sensor"].update(img_means=["x"] * 5)
        ),
        ConfigError,
        "arch_cfg",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_faulty_archive_is_refused(archive: Path, fault: str) -> None:
    damage, error, message = FAULTS[fault]
    damage(archive)
    with pytest.raises(error, match=message):
        load_archive(archive)


def test_a_width_that_cannot_be_halved_four_times_is_refused(archive: Path) -> None:
    with pytest.raises(ConfigError, match="1000 columns.*multiple of 16"):
        load_archive(archive, columns=1000)


def test_scans_without_labels_are_refused(archive: Path) -> None:
    scan = random_scan(presets()["town"], 500, seed=0)
    judge = load_archive(archive, columns=64)
    with pytest.raises(DataError, match="without labels"):
        judge.confusion([replace(scan, label=None)])
    with pytest.raises(DataError, match="no labelled return"):
        recognise(
            judge,
            [replace(scan, label=np.full(len(scan), IGNORE, np.uint8))],
            progress=False,
        )


@pytest.mark.slow
def test_the_command_line_prints_both_sets(archive: Path, tmp_path: Path) -> None:
    for seed in (0, 1):
        town = [
            str(tmp_path / f"town{seed}"),
            "--scans",
            "2",
            "--seed",
            str(seed),
            "--no-camera",
        ]
        assert (
            CliRunner()
            .invoke(app, ["town", *town, "--layout", "semantic_kitti"])
            .exit_code
            == 0
        )
    call = [
        "evaluate",
        str(tmp_path / "town0"),
        str(tmp_path / "town1"),
        "--judge",
        str(archive),
        "--columns",
        "256",
    ]
    result = CliRunner().invoke(app, call)
    assert result.exit_code == 0, result.output
    assert "| accuracy |" in result.output and "| vegetation |" in result.output
    figures = json.loads(CliRunner().invoke(app, [*call, "--json"]).stdout)
    assert figures["real"]["scans"] == 2 and figures["frechet_distance"] >= 0
    assert CliRunner().invoke(app, [*call, "--protocol", "town"]).exit_code == 2


@pytest.fixture(scope="module")
def street_judge() -> StreetJudge:
    return load_archive(_folder("LIDAR_SYNTH_JUDGE") / "squeezeseg")


@pytest.mark.slow
def test_a_real_archive_has_its_accuracy_on_a_sequence_that_it_never_saw(
    street_judge: StreetJudge,
) -> None:
    folder = _folder("LIDAR_SYNTH_LABELLED_SCANS") / "semantic_kitti"
    if not (folder / "sequences" / "08").is_dir():
        pytest.skip(f"{folder} without sequence 08; the others trained the network")
    scans = open_scans(folder, split="val")
    found = recognise(
        street_judge, [scans[i] for i in range(min(10, len(scans)))], progress=False
    )
    assert found.accuracy == pytest.approx(0.740, abs=0.01)


@pytest.mark.slow
def test_a_real_archive_recognises_real_streets(street_judge: StreetJudge) -> None:
    scans = open_scans(_folder("LIDAR_SYNTH_LABELLED_SCANS") / "semantic_kitti")
    found = recognise(
        street_judge, [scans[i] for i in range(0, len(scans), 7)], progress=False
    )
    assert found.accuracy > 0.7  # 0.753 over all 28 frames at 64 x 2048
    assert (
        found.iou()["road"] > 0.6
        and found.iou()["car"] > 0.6
        and found.iou()["vegetation"] > 0.5
    )


@pytest.mark.parametrize("value", ["x", 1.5, -1, 2**40, None, [1], True])
def test_ids_that_are_no_class_numbers_are_refused(archive: Path, value: Any) -> None:
    path = archive / "data_cfg.yaml"
    settings = yaml.safe_load(path.read_text())
    settings["learning_map_inv"][3] = value
    path.write_text(yaml.safe_dump(settings))
    with pytest.raises(ConfigError, match="data_cfg.yaml lacks or misstates"):
        load_archive(archive)
