"""The demo: which scans it holds out, and that both trainings of its comparison differ in nothing
but the mixture."""

import importlib
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from conftest import random_scan
from pictures import SMALL
from project import ROOT

from lidar_synth.formats import WRITERS
from lidar_synth.geometry.projection import project
from lidar_synth.geometry.scan import SYNTHETIC, Scan
from lidar_synth.geometry.sensor import load_sensor


@pytest.fixture
def tools(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "tools"))


@pytest.fixture
def demo(tools: None) -> ModuleType:
    return importlib.import_module("demo")


@pytest.fixture
def comparison(tools: None) -> ModuleType:
    return importlib.import_module("comparison")


def write_sequences(root: Path, names: list[str], scans: int) -> None:
    """A dataset in SemanticKITTI's layout."""
    writer = WRITERS["semantic_kitti"](root)
    sensor = load_sensor("hdl64e_semantic_kitti")
    for i, name in enumerate(
        f"{sequence}/{frame:06d}" for sequence in names for frame in range(scans)
    ):
        writer.write(replace(random_scan(sensor, 50, i), id=name), i, name=name)
    writer.finish()


@pytest.mark.parametrize(
    ("sequences", "held_out"),
    [
        (["00", "08", "10"], "08"),
        (["00", "03", "09"], "09"),
        (["00", "05", "14"], "05"),
    ],
)
def test_a_sequence_that_is_never_trained_on_is_held_out(
    demo: ModuleType, tmp_path: Path, sequences: list[str], held_out: str
) -> None:
    write_sequences(tmp_path, sequences, 4)
    data = demo.semantic_kitti(str(tmp_path), 3)
    assert {scan.id[:2] for scan in data.held_out} == {held_out}
    assert {scan.id[:2] for scan in data.real} <= set(sequences) - {held_out, "14"}
    assert (len(data.real), len(data.held_out)) == (3, 3)
    assert f"sequence {held_out}" in data.place


def test_one_sequence_alone_is_refused(demo: ModuleType, tmp_path: Path) -> None:
    write_sequences(tmp_path, ["04"], 2)
    with pytest.raises(SystemExit, match="one labelled sequence; expected two or more"):
        demo.semantic_kitti(str(tmp_path), 3)


def write_drives(root: Path, drives: list[int], scans: int, labelled: bool) -> None:
    """A dataset in KITTI-360's layout."""
    writer = WRITERS["kitti360"](root)
    sensor = load_sensor("hdl64e_kitti360")
    for drive in drives:
        for frame in range(scans):
            scan = random_scan(sensor, 50, frame)
            kept = (
                scan
                if labelled
                else replace(scan, label=None, raw_label=None, instance=None)
            )
            writer.write(kept, frame, name=f"{drive:02d}/{frame}")
    writer.finish()


@pytest.mark.parametrize(
    ("drives", "held_out"),
    [([4, 5, 0], {5}), ([4], {4})],
    ids=["several drives", "one drive"],
)
def test_labelled_scans_of_kitti360_are_split_by_place(
    demo: ModuleType, tmp_path: Path, drives: list[int], held_out: set[int]
) -> None:
    write_drives(tmp_path, drives, 8, labelled=True)
    data = demo.kitti360(str(tmp_path), 3)
    assert data.labelled and len(data.real) == 3 and len(data.held_out) in (2, 3)
    assert {int(scan.id[19:21]) for scan in data.held_out} == held_out
    assert max(scan.id for scan in data.real) < min(scan.id for scan in data.held_out)


def test_kitti360_without_labels_is_not_trained_on(
    demo: ModuleType, tmp_path: Path
) -> None:
    write_drives(tmp_path, [4], 4, labelled=False)
    data = demo.kitti360(str(tmp_path), 3)
    assert (
        not data.labelled
        and not data.held_out
        and f"lidar-synth label kitti360 {tmp_path}" in data.notes
    )


def test_the_town_that_is_held_out_is_another_one(
    demo: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seeds = {}

    def command(*words: str) -> None:
        seeds[Path(words[1]).name] = words[words.index("--seed") + 1]
        write_sequences(Path(words[1]), ["00"], 2)

    monkeypatch.setattr(demo, "command", command)
    data = demo.town(tmp_path, 2, 6)
    assert seeds == {"town": "6", "other_town": "7"}
    assert "take the place of your real ones" in data.notes
    assert "in place of a real one" in data.name


def some_scans(first: int, count: int) -> list[Scan]:
    return [random_scan(SMALL, 800, seed) for seed in range(first, first + count)]


@pytest.mark.usefixtures("one_thread")
def test_a_training_depends_on_nothing_but_its_protocol(comparison: ModuleType) -> None:
    synthetic = [replace(scan, domain=SYNTHETIC) for scan in some_scans(10, 2)]
    other = [replace(scan, domain=SYNTHETIC) for scan in some_scans(20, 2)]
    protocol = comparison.Protocol(
        some_scans(0, 3), synthetic, some_scans(30, 2), ratio=0.5, steps=3
    )
    again = replace(protocol, synthetic=other)
    np.testing.assert_array_equal(
        protocol.train(0.0, 0), again.train(0.0, 0), "real scans only"
    )
    assert (protocol.train(0.5, 0) != again.train(0.5, 0)).any(), (
        "synthetic scans are trained on"
    )
    assert (protocol.train(0.0, 0) != protocol.train(0.0, 1)).any(), "seeds differ"
    assert protocol.train(0.0, 0).sum() == sum(
        (project(s).label < 19).sum() for s in protocol.held_out
    )


@pytest.mark.usefixtures("one_thread")
def test_both_trainings_have_as_many_iterations_and_the_same_augmentation(
    comparison: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = []

    def train(
        network: object, batches: object, height: object, steps: int, progress: bool
    ) -> None:
        taken = [batch for _, batch in zip(range(steps), batches, strict=False)]
        seen.append(
            (
                steps,
                {len(batch["domain"]) for batch in taken},
                sum(int(b["domain"].sum()) for b in taken),
            )
        )

    augmented = []
    monkeypatch.setattr(comparison, "train_segmenter", train)
    monkeypatch.setattr(
        comparison, "AUGMENT", lambda scan, rng: augmented.append(scan.domain) or scan
    )
    protocol = comparison.Protocol(
        some_scans(0, 6),
        some_scans(10, 4),
        some_scans(30, 1),
        ratio=0.25,
        steps=8,
        batch=2,
    )
    for ratio in (0.0, 0.25):
        protocol.train(ratio, 0)
    assert seen == [(8, {2}, 0), (8, {2}, 4)], "16 samples, a quarter of them synthetic"
    assert augmented.count(0) + augmented.count(1) == len(augmented) >= 32
    assert augmented.count(1) >= 4, "synthetic scans are augmented too"


@pytest.mark.slow
def test_a_comparison_runs_both_arms_with_every_seed(comparison: ModuleType) -> None:
    protocol = comparison.Protocol(
        some_scans(0, 2), some_scans(10, 2), some_scans(30, 1), steps=2, seeds=2
    )
    result = comparison.compare(protocol, jobs=1)
    without, with_synthetic = result.scores()
    assert len(without) == len(with_synthetic) == 2
    for ratio, tables in ((0.0, result.without), (0.25, result.with_synthetic)):
        for seed, table in enumerate(tables):
            assert table.sum() == protocol.train(ratio, seed).sum()
    classes = np.isnan(result.ious()[0])
    np.testing.assert_array_equal(classes, result.without[0].sum(1) == 0)
