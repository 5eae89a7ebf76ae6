"""Training the range-view segmenter, and judging by it."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import random_scan

from lidar_synth.datasets.classes import IGNORE
from lidar_synth.errors import DataError
from lidar_synth.geometry.projection import project
from lidar_synth.geometry.sensor import presets
from lidar_synth.lab.evaluate.segmentation import (
    Images,
    Judge,
    class_ious,
    confusion,
    load_judge,
    mean_iou,
)
from lidar_synth.lab.evaluate.segmenter import RangeSegmenter, segmenter_input
from lidar_synth.lab.train.segmentation import balanced_cross_entropy, train_segmenter

HEIGHT = torch.linspace(0.05, -0.4, 16)[:, None].expand(16, 32)


def batches(count: int, seed: int = 0) -> list[Images]:
    """Scans whose label is the reflectance: two classes; every fourth column is ignored."""
    draw = torch.Generator().manual_seed(seed)
    made = []
    for _ in range(count):
        reflectance = torch.rand(2, 16, 32, generator=draw)
        label = torch.where(reflectance > 0.5, 8, 12).to(torch.uint8)
        label[..., ::4] = IGNORE
        made.append(
            {
                "range": 5 + 20 * torch.rand(2, 16, 32, generator=draw),
                "reflectance": reflectance,
                "label": label,
            }
        )
    return made


def test_the_segmenter_learns_as_its_confusion_matrix_shows() -> None:
    torch.manual_seed(0)
    network = RangeSegmenter(widths=(8, 8, 8))
    untrained = mean_iou(confusion(network.eval(), batches(4, 1), HEIGHT))
    losses = train_segmenter(
        network, batches(80), HEIGHT, 80, rate=2e-2, progress=False
    )
    table = confusion(network, batches(4, 1), HEIGHT)
    assert np.mean(losses[-5:]) < 0.5 * losses[0]
    assert table.sum() == 4 * 2 * 16 * 24, "ignored cells are counted"
    assert mean_iou(table) > max(0.8, untrained)


def test_a_rare_class_counts_by_the_square_root_of_its_share() -> None:
    target = torch.full((1, 4, 25), 8)
    target[0, 0, :4] = 7
    target[0, 3] = IGNORE
    logits = torch.zeros(1, 19, 4, 25)
    logits[:, 8] = 3.0
    rare, common = (-logits.log_softmax(1)[0, c, 0, 0] for c in (7, 8))
    parts = torch.tensor([4.0, 71.0])
    weights = (parts / 75 + 1e-4) ** -0.5 * parts
    expected = (weights[0] * rare + weights[1] * common) / weights.sum()
    loss = balanced_cross_entropy(logits, target)
    torch.testing.assert_close(loss, expected)
    assert loss > (4 * rare + 71 * common) / 75, "as if every cell counted alike"


def test_ious_by_hand() -> None:
    table = np.zeros((19, 19), np.int64)
    table[0, 0] = 6
    table[0, 1] = 2
    table[1, 1] = 3
    table[1, 2] = 1
    ious = class_ious(table)
    assert ious[0] == 6 / 8 and ious[1] == 3 / 6 and ious[2] == 0
    assert np.isnan(ious[3:]).all()
    assert mean_iou(table) == (6 / 8 + 3 / 6) / 2, (
        "a class that is said but never labelled counts by its mistakes"
    )


@pytest.mark.slow
def test_what_cannot_be_trained_on_is_refused() -> None:
    network = RangeSegmenter(widths=(8, 8, 8))
    empty = [{**b, "label": torch.full_like(b["label"], IGNORE)} for b in batches(1)]
    with pytest.raises(DataError, match="without one valid label"):
        train_segmenter(network, empty, HEIGHT, 1, progress=False)
    with pytest.raises(DataError, match="2 batches for 3 steps"):
        train_segmenter(network, batches(2), HEIGHT, 3, progress=False)
    with pytest.raises(DataError, match="no labelled cell"):
        mean_iou(confusion(network, empty, HEIGHT))


@pytest.fixture
def judge() -> Judge:
    torch.manual_seed(0)
    return Judge(RangeSegmenter().eval(), presets()["town"], {"data": "none"})


@pytest.mark.slow
def test_a_judge_sees_a_scan_as_the_network_sees_its_image(judge: Judge) -> None:
    scan = random_scan(presets()["town"], 3000, seed=0)
    image = project(scan)
    height = torch.from_numpy(np.sin(presets()["town"].ray_angles()[0]))
    inputs = segmenter_input(
        torch.from_numpy(image.range)[None],
        torch.from_numpy(image.channels["reflectance"])[None],
        height,
    )
    with torch.inference_mode():
        assert np.allclose(
            judge.features([scan]), judge.network.features(inputs).numpy()
        )
        said = judge.network(inputs)[0].argmax(0).numpy()
    label = image.channels["label"]
    table = judge.agreement([scan])
    assert table.sum() == (label != IGNORE).sum() > 0
    assert np.trace(table) == (said == label)[label != IGNORE].sum()


@pytest.mark.slow
def test_a_judge_is_kept_whole(judge: Judge, tmp_path: Path) -> None:
    judge.save(tmp_path / "a.safetensors")
    again = load_judge(tmp_path / "a.safetensors")
    assert (again.sensor, again.provenance) == (judge.sensor, judge.provenance)
    scan = random_scan(presets()["town"], 3000, seed=0)
    assert np.array_equal(again.features([scan]), judge.features([scan]))


@pytest.mark.parametrize(
    "damage",
    [
        lambda b: b[: len(b) // 2],
        lambda b: b"",
        lambda b: b.replace(b"segmenter/1", b"segmenter/2"),
    ],
)
def test_a_damaged_judge_is_refused(
    judge: Judge, tmp_path: Path, damage: Callable[[bytes], bytes]
) -> None:
    path = tmp_path / "a.safetensors"
    judge.save(path)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(DataError, match=r"not a segmenter of this version"):
        load_judge(path)


def test_scans_without_labels_cannot_be_judged_for_them(judge: Judge) -> None:
    scan = replace(random_scan(presets()["town"], 300, seed=0), label=None)
    with pytest.raises(DataError, match="without labels"):
        judge.agreement([scan])
