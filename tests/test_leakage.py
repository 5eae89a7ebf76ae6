"""The training data of models beside references that may hold it."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from banks import some_image, write_bank
from conftest import random_scan
from layouts import write_all
from typer.testing import CliRunner

from lidar_synth.cli import app
from lidar_synth.datasets.recordings import MODELS, NOTE, all_frames
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.formats import WRITERS, layout_of, open_scans
from lidar_synth.formats.convert import convert
from lidar_synth.geometry.scan import SYNTHETIC, Scan
from lidar_synth.geometry.sensor import presets
from lidar_synth.lab.evaluate.leakage import (
    content_of,
    contents,
    measured,
    overlap,
    recordings_of,
    seen_by_model_of,
)
from lidar_synth.lab.town.export import SETTINGS

MADE = {"made_by": "model", "model": "small", "checkpoint": "c" * 64, "seed": 1}


def some(count: int, seed: int = 0) -> list[Scan]:
    return [random_scan(presets()["town"], 2000, seed=seed + i) for i in range(count)]


@pytest.mark.parametrize("to", ["kitti", "semantic_kitti", "kitti360"])
def test_a_scan_is_known_by_its_hash_in_every_layout(tmp_path: Path, to: str) -> None:
    scans = some(3)
    write_all(to, tmp_path, scans)
    for known, found in ((scans[1], True), (some(1, seed=9)[0], False)):
        seen = contents([content_of(known)])
        reference = measured(
            open_scans(tmp_path), layout_of(tmp_path), tmp_path, None, seen
        )
        assert bool(overlap(seen, reference)) == found


def test_scans_are_not_read_for_a_model_without_hashes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_all("semantic_kitti", tmp_path, some(2))
    monkeypatch.setattr(
        "lidar_synth.lab.evaluate.leakage.content_of",
        lambda scan: pytest.fail("a scan was hashed"),
    )
    measured(
        open_scans(tmp_path),
        "semantic_kitti",
        tmp_path,
        None,
        all_frames("KITTI-360", ["a drive"]),
    )


@pytest.mark.parametrize("text", ["{", "[]", "5", '{"seen": 3}', "[" * 100_000, "null"])
def test_a_damaged_note_is_an_error_that_names_it(tmp_path: Path, text: str) -> None:
    write_all("kitti", tmp_path, some(1))
    (tmp_path / NOTE).write_text(text)
    with pytest.raises(DataError, match="recordings 3" if "seen" in text else NOTE):
        seen_by_model_of(tmp_path)
    if "seen" not in text:
        (tmp_path / SETTINGS).write_text(text)
        with pytest.raises(DataError, match=SETTINGS):
            recordings_of(open_scans(tmp_path), "folder", tmp_path)


def generated(folder: Path, to: str, note: dict[str, object] | None = None) -> Path:
    made = [
        replace(scan, domain=SYNTHETIC, provenance=MADE) for scan in some(3, seed=5)
    ]
    write_all(to, folder, made)
    if note is not None:
        (folder / NOTE).write_text(json.dumps(note))
    return folder


def test_scans_of_an_unknown_model_are_compared_with_a_note(tmp_path: Path) -> None:
    write_all("npz", tmp_path / "real", some(3))
    call = ["evaluate", str(tmp_path / "real"), "--protocol", "town"]
    for to in ("kitti", "npz"):
        result = CliRunner().invoke(app, [*call, str(generated(tmp_path / to, to))])
        assert result.exception is None, result.output
        assert "does not record its model's training data" in result.stderr
    write_all("npz", tmp_path / "others", some(3, seed=5))
    assert (
        "does not record"
        not in CliRunner().invoke(app, [*call, str(tmp_path / "others")]).stderr
    )


@pytest.mark.parametrize("first", ["sampled", "baked"])
def test_converted_scans_keep_what_their_model_has_seen(
    tmp_path: Path, first: str
) -> None:
    known = {"data": "?", "seen": contents([content_of(some(1)[0])]).to_list()}
    if first == "sampled":
        start = generated(
            tmp_path / "0", "npz", {"trained_on": "?", "seed": 3, "seen": known["seen"]}
        )
    else:
        start = write_bank(
            tmp_path / "0", [some_image(i) for i in range(3)], provenance=known
        )[0].parent
    for number, to in enumerate(["kitti", "webdataset", "semantic_kitti"]):
        convert(
            open_scans(tmp_path / str(number)),
            WRITERS[to](tmp_path / str(number + 1)),
            progress=False,
        )
    assert seen_by_model_of(tmp_path / "3") == seen_by_model_of(start)
    assert seen_by_model_of(start)
    write_all("semantic_kitti", tmp_path / "real", some(3))
    result = CliRunner().invoke(
        app,
        ["evaluate", str(tmp_path / "real"), str(tmp_path / "3"), "--protocol", "town"],
    )
    assert isinstance(
        result.exception, ConfigError
    ) and "was trained on content" in str(result.exception)
    (tmp_path / "3" / MODELS).write_text('{"models": [5]}')
    with pytest.raises(DataError, match=MODELS):
        seen_by_model_of(tmp_path / "3")


def test_scans_that_no_model_made_get_no_note(tmp_path: Path) -> None:
    write_all("npz", tmp_path / "in", some(1))
    convert(
        open_scans(tmp_path / "in"), WRITERS["kitti"](tmp_path / "out"), progress=False
    )
    assert (
        not (tmp_path / "out" / MODELS).exists()
        and seen_by_model_of(tmp_path / "out") is None
    )
