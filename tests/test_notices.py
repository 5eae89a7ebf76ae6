"""What would harm a training without an error is logged once."""

import ast
import itertools
import logging
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
import pytest
from mixtures import SENSOR, Endless, Scans, as_is
from streets import kitti, street
from torch.utils.data import DataLoader, Subset

from lidar_synth import mix
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.formats import WRITERS, KITTIObject, open_scans
from lidar_synth.geometry.scan import Scan
from lidar_synth.mixing import MixedScans, notices


class Dense(Scans):
    """Real scans with twice the points of synthetic ones."""

    def __init__(self, count: int) -> None:
        super().__init__("r", count)
        self[:] = [twice(scan) for scan in self]


def twice(scan: Scan) -> Scan:
    fields = {
        name: np.concatenate([values, values]) for name, values in scan.fields().items()
    }
    return replace(scan, points=np.concatenate([scan.points, scan.points]), **fields)


def logged(train: MixedScans, caplog: pytest.LogCaptureFixture) -> list[str]:
    for epoch in range(2):
        train.set_epoch(epoch)
        for i in range(len(train)):
            train[i]
    return [
        record.getMessage()
        for record in caplog.records
        if record.levelno >= logging.WARNING
    ]


def test_another_density_is_reported_once(caplog: pytest.LogCaptureFixture) -> None:
    [message] = logged(MixedScans(Dense(12), Endless(), 0.5), caplog)
    assert "a real scan has" in message and "columns=" in message
    assert "in_view(scan, real.calibration(0))" in message


@pytest.mark.parametrize("collate", ["offsets", "range"])
def test_a_like_density_or_range_images_are_not_reported(
    collate: str, caplog: pytest.LogCaptureFixture
) -> None:
    real = Dense(12) if collate == "range" else Scans("r", 12)
    train = MixedScans(real, Endless(), 0.5, collate=collate)  # type: ignore[arg-type]
    assert not logged(train, caplog)


def test_reflectances_of_another_scale_are_reported_once(
    caplog: pytest.LogCaptureFixture,
) -> None:
    real = [replace(scan, reflectance=scan.reflectance * 255) for scan in Scans("r", 6)]
    [message] = logged(MixedScans(real, Endless(), 0.5, collate="range"), caplog)
    assert "has reflectances up to 2" in message and "255 by 255" in message


def test_a_tiny_bank_is_reported(caplog: pytest.LogCaptureFixture) -> None:
    MixedScans(Scans("r", 28), Scans("s", 6), 0.9)
    assert (
        "the 6 scans of a synthetic source" in caplog.text
        and "come 42 times each" in caplog.text
    )
    caplog.clear()
    MixedScans(Scans("r", 28), Scans("s", 6), 0.4)
    MixedScans(Scans("r", 28), Endless(), 0.9)
    assert not caplog.text


@pytest.mark.parametrize("ignored", [False, True])
def test_unlabelled_real_scans_are_reported_once(
    ignored: bool, caplog: pytest.LogCaptureFixture
) -> None:
    real = Scans("r", 12)
    for i in (3, 5):
        real[i] = replace(
            real[i], label=np.full(len(real[i]), 255, np.uint8) if ignored else None
        )
    messages = logged(MixedScans(real, Endless(), 0.5), caplog)
    assert (
        len(messages) == 1
        and "has no labels" in messages[0]
        and "lidar-synth label kitti360" in messages[0]
    )


def test_unlabelled_real_scans_in_an_unlabelled_mixture_are_not(
    caplog: pytest.LogCaptureFixture,
) -> None:
    real = Scans("r", 12)
    real[:] = [replace(scan, label=None) for scan in real]
    assert not logged(MixedScans(real, Endless(), 0.5, labels="none"), caplog)


def test_unlabelled_real_scans_of_a_detector_are_not(
    caplog: pytest.LogCaptureFixture,
) -> None:
    real = [replace(street(i), label=None, instance=None) for i in range(4)]
    train = mix(real, [street(9), street(8)], 0.5, task="detection", epochs=8)
    assert not logged(train, caplog)


@pytest.mark.parametrize("labels", ["boxes", "paste"])
def test_real_scans_whose_boxes_are_not_known_are_for_a_detector(
    labels: str,
    caplog: pytest.LogCaptureFixture,
) -> None:
    real = [street(i) for i in range(4)]
    real[1] = replace(real[1], boxes=None)
    options: dict[str, Any] = {"epoch_size": 8, "augment": None}
    assert not logged(MixedScans(real, [street(9)], 0.25, **options), caplog)
    [message] = logged(MixedScans(real, [street(9)], 0.25, labels, **options), caplog)
    assert repr(real[1].id) in message and "Subset(scans" in message
    known = Subset(real, [i for i, scan in enumerate(real) if scan.boxes is not None])
    caplog.clear()
    assert not logged(MixedScans(known, [street(9)], 0.25, labels, **options), caplog)


@pytest.mark.parametrize("mixes", ["lasermix", "polarmix_or_lasermix"])
def test_an_augmentation_that_removes_boxes_is_refused_for_a_detector(
    mixes: str, caplog: pytest.LogCaptureFixture
) -> None:
    real = [street(i) for i in range(2)]
    options: dict[str, Any] = {"augment": mixes, "augment_real": True, "epoch_size": 8}
    for labels in ("boxes", "paste"):
        train = MixedScans(real, [street(9)], 0.5, labels, **options)
        with pytest.raises(ConfigError, match="augment= that removes the boxes of"):
            logged(train, caplog)
    recipe = mix(real, [street(9)], task="detection", epochs=8, augment=mixes)
    with pytest.raises(ConfigError, match="augment= that removes the boxes of"):
        logged(recipe, caplog)
    caplog.clear()
    [message] = logged(MixedScans(real, [street(9)], 0.5, **options), caplog)
    assert "augment= removes the boxes" in message


@pytest.mark.parametrize("augment", [None, "lasermix"])
def test_scans_without_boxes_are_reported_unless_a_segmenter_is_trained(
    augment: str | None, caplog: pytest.LogCaptureFixture
) -> None:
    real = [street(i) for i in range(4)]
    bare = [street(9)] if augment else [replace(street(9), boxes=None)]
    options: dict[str, Any] = {"augment": augment, "epoch_size": 8}
    assert not logged(mix(real, bare, **options), caplog)
    [message] = logged(MixedScans(real, bare, **options), caplog)
    assert "a detector would learn that their objects are background" in message


def test_names_that_differ_by_capitals_are(caplog: pytest.LogCaptureFixture) -> None:
    real = [street(i) for i in range(4)]
    for scan in real:
        assert scan.boxes is not None
        lower = tuple(map(str.lower, scan.boxes.names))
        scan.boxes = replace(scan.boxes, names=lower)
    [message] = logged(MixedScans(real, [street(9)], 0.25, "boxes"), caplog)
    assert "'Car'" in message and "'car'" in message and "by capitals" in message


def test_scans_that_are_not_finite_are_refused_or_reported(
    caplog: pytest.LogCaptureFixture,
) -> None:
    real = Scans("r", 4)
    nan = np.full_like(real[0].reflectance, np.nan)
    real[0] = replace(real[0], reflectance=nan)
    [message] = logged(MixedScans(real, Endless(), 0.5), caplog)
    assert "'r0' has returns of reflectance NaN" in message
    real[0] = replace(real[0], points=real[0].points * np.float32(np.nan))
    with pytest.raises(DataError, match="'r0' with points that are NaN"):
        logged(MixedScans(real, Endless(), 0.5), caplog)
    with pytest.raises(DataError, match="'r0' with points that are NaN"):
        logged(MixedScans(Scans("r", 4), real, 0.5), caplog)


def test_points_outside_of_the_view_that_has_boxes_are(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    real = KITTIObject(kitti(tmp_path / "k", 2))
    mix(real.with_boxes(), [street(9)], task="detection", epochs=8)
    assert "with_boxes()" not in caplog.text
    mix(real, [street(9)], task="detection", epochs=8)
    assert "Take open_scans" in caplog.text and "with_boxes()" in caplog.text


@pytest.mark.parametrize(
    ("sequences", "told"), [("00 08 11", True), ("00 01", False), ("08", False)]
)
def test_scans_of_validation_and_test_are(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, sequences: str, told: bool
) -> None:
    writer = WRITERS["semantic_kitti"](tmp_path)
    for sequence in sequences.split():
        writer.write(street(0), 0, name=f"{sequence}/000000")
    writer.finish()
    mix(tmp_path, [street(9)], 0.5)
    assert ("split='train'" in caplog.text) == told
    caplog.clear()
    mix(open_scans(tmp_path), [street(9)], 0.5)
    assert not caplog.text


def test_a_sampler_made_anew_for_each_epoch_does_not_hide_a_repetition() -> None:
    train = MixedScans(Scans("r", 4), Endless(), 0.5, to_sample=as_is)
    assert train.synthetic[0].sensor == SENSOR

    def run_epoch() -> None:
        for _ in DataLoader(train, batch_sampler=train.batches(2), collate_fn=list):
            pass

    run_epoch()
    with pytest.warns(UserWarning, match="epoch 0 begins again"):
        run_epoch()
    train.set_epoch(1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run_epoch()


def test_a_message_is_not_repeated_by_the_workers_of_the_next_epoch(
    tmp_path: Path,
) -> None:
    loader = MixedScans(Dense(12), Endless(), 0.5).loader(4, 2)
    handler = logging.FileHandler(tmp_path / "log.txt")
    logging.getLogger("lidar_synth").addHandler(handler)
    try:
        for batch in itertools.chain(loader, loader, loader):
            assert len(batch["id"])
    finally:
        logging.getLogger("lidar_synth").removeHandler(handler)
    assert (tmp_path / "log.txt").read_text().count("a real scan has") == 1


def test_messages_have_bits_of_their_own() -> None:
    calls = [
        node.args[0]
        for node in ast.walk(ast.parse(Path(notices.__file__).read_text()))
        if isinstance(node, ast.Call)
        and getattr(node.func, "attr", "") in ("_warn", "_is_new")
    ]
    texts = [c.value for c in calls if isinstance(c, ast.Constant)]
    bits = {crc32(str(text).encode()) % 63 for text in texts}
    assert len(bits) == len(texts) > 8


def test_an_augmentation_that_returns_no_scan_is_refused() -> None:
    train = MixedScans([street(0)], [street(9)], 0.5, augment=lambda scan, rng: None)
    with pytest.raises(ConfigError, match="augment= returned NoneType.*a Scan"):
        list(train)
