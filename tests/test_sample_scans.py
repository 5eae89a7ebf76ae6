"""The recorded scans that ship with the package."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from banks import some_facts
from project import ROOT

from lidar_synth import MixedScans, PandaSet, project, sample_scans
from lidar_synth.bake.verify import check_scans
from lidar_synth.bank import Bank, Entry, Index
from lidar_synth.bank.card import dataset_card
from lidar_synth.datasets.recordings import frames_of, seen_by
from lidar_synth.formats import open_scans
from lidar_synth.formats.models import models_of
from lidar_synth.geometry.scan import REAL, SYNTHETIC
from lidar_synth.mixing.synthetic import make_synthetic

FRAMES = [0, 10, 20, 30, 40, 50, 60, 70]


def test_the_sample_has_recorded_scans_with_labels_and_boxes() -> None:
    scans = sample_scans()
    assert len(scans) == 8 and scans.sensor.name == "pandar64"
    for scan in scans:
        assert (scan.domain, scan.provenance) == (REAL, {})
        assert len(scan) > 105_000 and (scan.label != 255).mean() > 0.7
        held = np.bincount(scan.instance, minlength=len(scan.boxes) + 1)
        assert len(scan.boxes) > 60 and (held[1:] > 0).mean() > 0.9
        assert {"Car", "Truck", "Pedestrian", "Misc"} == set(scan.boxes.names)


def test_the_sample_is_small_and_intact() -> None:
    scans = sample_scans()
    assert sum(path.stat().st_size for path in scans.root.iterdir()) < 1.7e6
    [entry] = scans.index.shards
    assert list(check_scans(scans.root / entry.file, scans.facts, entry)) == []


def test_the_card_of_the_sample_states_attribution_and_terms() -> None:
    card = (sample_scans().root / "README.md").read_text()
    assert card == dataset_card("pandaset", sample_scans().index)
    for text in (
        'license: "cc-by-4.0"',
        "Recorded LiDAR scans",
        "attribute Scale AI and Hesai",
        "do not attempt to identify persons",
        "creativecommons.org/licenses/by/4.0",
        "Changes: ",
        "do not endorse",
    ):
        assert text in card
    assert "synthetic" not in card.lower()


def test_scans_of_the_sample_count_as_seen_by_what_learnt_from_that_street() -> None:
    [found] = models_of(sample_scans().root)
    ids = [f"002/{frame:02d}" for frame in FRAMES]
    assert seen_by(found) == frames_of("pandaset", ids)


@pytest.mark.parametrize(("frame", "index"), [(0, 0), (1, 4)])
def test_the_sample_agrees_with_the_reader_of_pandaset(
    frame: int, index: int, labelled_scans: Path
) -> None:
    scan = PandaSet(labelled_scans / "pandaset" / "as_published")[frame]
    expected = project(scan)
    image = sample_scans().image(index)
    assert (image.mask == expected.mask).mean() > 0.9999
    both = image.mask & expected.mask
    apart = np.abs(image.range - expected.range)[both]
    assert apart.max() <= 0.01
    assert (image.label == expected.label)[both].mean() > 0.9999
    nearest = np.linalg.norm(
        image.boxes.values[:, None] - scan.boxes.values, axis=-1
    ).min(1)
    assert nearest.max() < 1e-3


def test_the_script_writes_the_sample(
    tmp_path: Path, labelled_scans: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "tools" / "research"))
    import make_sample

    make_sample.main(labelled_scans / "pandaset" / "sensor_frame", tmp_path)
    made = Bank(tmp_path)
    assert made.facts == sample_scans().facts
    for index in range(8):
        arrays = [b.shard(0).read(index) for b in (made, sample_scans())]
        assert all(
            np.array_equal(arrays[0][name], arrays[1][name]) for name in arrays[0]
        )


def test_the_sample_opens_like_any_bank_and_mixes_as_real_scans() -> None:
    scans = open_scans(sample_scans().root)
    assert scans[3].domain == REAL and scans.ids[3] == "pandaset/2/3"
    mixed = MixedScans(sample_scans(), sample_scans(), 0.5)
    assert {mixed.domain(i) for i in range(len(mixed))} == {REAL, SYNTHETIC}


def test_recorded_scans_that_stand_in_for_synthetic_ones_say_so() -> None:
    assert make_synthetic(sample_scans())[0].domain == SYNTHETIC


def test_a_card_says_when_some_scans_are_generated() -> None:
    recorded = sample_scans().facts
    made = replace(some_facts(recorded.sensor), fields=recorded.fields)
    entries = [
        Entry(f"shard-0000{i}.h5", 0, 0, 4, source=i, bytes=9999) for i in range(2)
    ]
    card = dataset_card("both", Index((recorded, made), tuple(entries)))
    assert "of which models generated some" in card
    assert 'license: ["cc-by-4.0", "mit"]' in card and "synthetic" in card
