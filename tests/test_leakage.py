"""The training data of models beside references that may hold it."""

from pathlib import Path

import pytest
from conftest import random_scan
from layouts import write_all

from lidar_synth.datasets.recordings import NOTE, whole
from lidar_synth.errors import DataError
from lidar_synth.evaluate.leakage import content_of, contents, measured, overlap, recordings_of, seen_by_model_of
from lidar_synth.formats import layout_of, open_scans
from lidar_synth.geometry.scan import Scan
from lidar_synth.geometry.sensor import presets
from lidar_synth.town.export import SETTINGS


def some(count: int, seed: int = 0) -> list[Scan]:
    return [random_scan(presets()["town"], 2000, seed=seed + i) for i in range(count)]


@pytest.mark.parametrize("to", ["kitti", "semantic_kitti", "kitti360"])
def test_a_scan_is_known_by_its_hash_in_every_layout(tmp_path: Path, to: str) -> None:
    scans = some(3)
    write_all(to, tmp_path, scans)
    for known, found in ((scans[1], True), (some(1, seed=9)[0], False)):
        seen = contents([content_of(known)])
        reference = measured(open_scans(tmp_path), layout_of(tmp_path), tmp_path, None, seen)
        assert bool(overlap(seen, reference)) == found


def test_scans_are_not_read_for_a_model_without_hashes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_all("semantic_kitti", tmp_path, some(2))
    monkeypatch.setattr("lidar_synth.evaluate.leakage.content_of", lambda scan: pytest.fail("a scan was hashed"))
    measured(open_scans(tmp_path), "semantic_kitti", tmp_path, None, whole("KITTI-360", ["a drive"]))


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
