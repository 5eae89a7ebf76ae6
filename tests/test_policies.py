"""Label policies as objects: the same by name, equal by value, and with their own scans."""

import pickle
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from box_scenes import car, cast
from test_labels import CALLS, FIELDS, same

from lidar_synth import (
    KeepLabels,
    LaserMix,
    MixedScans,
    ObjectBank,
    PasteObjects,
    PolarMix,
    PolarMixOrLaserMix,
    RemoveLabels,
    make_policy,
)
from lidar_synth.datasets.classes import IGNORE
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.labels import POLICIES
from lidar_synth.noise import keyed_rng


@pytest.mark.parametrize("name", CALLS)
def test_a_policy_is_the_same_by_name_by_mapping_and_as_an_object(name: str) -> None:
    if name == "pseudo":
        pytest.skip("it cannot be made without a function")
    module, cls = POLICIES[name].split(".")
    options = CALLS[name]
    made = getattr(import_module(f"lidar_synth.labels.{module}"), cls)(**options)
    bank = [cast([car(8, 2)])]
    given = {"real": bank, "fields": FIELDS | {"boxes"}}
    scan = bank[0]
    scan.confidence = np.ones(len(scan), np.float32)
    scans = [
        make_policy(labels, **given, **more)(scan, keyed_rng(3))
        for labels, more in ((made, {}), ({name: options}, {}), (name, options))
    ]
    assert same(scans[0], scans[1]) and same(scans[0], scans[2])


@pytest.mark.parametrize(
    "labels", [7, None, {"generated": {}, "none": {}}, {"generated": 0.5}, {3: {}}, []]
)
def test_what_is_no_policy_is_refused(labels: Any) -> None:
    with pytest.raises(
        ConfigError, match=r"labels=.*expected (one of|arguments by name)"
    ):
        make_policy(labels, fields=FIELDS)


def test_policies_are_equal_by_value() -> None:
    assert KeepLabels(0.5) == KeepLabels(threshold=0.5) != KeepLabels()
    assert PolarMix(90) == PolarMix(width=90) != PolarMix(90, objects=0)
    objects = ObjectBank.from_scans([cast([car(8, 2)])])
    loaded = pickle.loads(pickle.dumps(objects))
    assert PasteObjects(objects) == PasteObjects(loaded) != PasteObjects(objects, 3)
    other = ObjectBank.from_scans([cast([car(9, 2)])])
    assert PasteObjects(objects) != PasteObjects(other)


def test_policies_with_their_own_scans_or_objects_need_no_mixture(
    tmp_path: Path,
) -> None:
    """As augmentations, and where a trainer's own dataset is wrapped."""
    real = [cast([car(8, 2)]), cast([car(-9, 5)])]
    synthetic = cast([car(20, 0)])
    for kind in (PolarMix, LaserMix, PolarMixOrLaserMix):
        bound = make_policy(kind(), real=real, fields=FIELDS)
        mixed = kind(real=real)(synthetic, keyed_rng(2))
        assert same(mixed, bound(synthetic, keyed_rng(2)))
        with pytest.raises(ConfigError, match="no real scans"):
            kind()(synthetic, keyed_rng(2))
    objects = ObjectBank.from_scans(real)
    objects.save(tmp_path / "objects.npz")
    pasted = PasteObjects(objects)(synthetic, keyed_rng(2))
    by_file = PasteObjects(tmp_path / "objects.npz")(synthetic, keyed_rng(2))
    by_name = make_policy("paste", real=real, fields=FIELDS)(synthetic, keyed_rng(2))
    assert same(pasted, by_file) and same(pasted, by_name)
    with pytest.raises(ConfigError, match="bank="):
        PasteObjects()(synthetic, keyed_rng(2))


def test_objects_in_boxes_need_no_instances() -> None:
    real = cast([car(8, 2)])
    unnumbered = replace(real, instance=None)
    for scan in (real, unnumbered):
        mixed = PolarMix(0, real=[scan])(cast(), keyed_rng(2))
        assert mixed.boxes is not None and mixed.boxes.names == ("Car",)
    with pytest.raises(DataError, match="no instances"):
        PolarMix(real=[replace(unnumbered, boxes=None)])(cast(), keyed_rng(2))


def test_an_unlabelled_pool_makes_batches_by_name_and_as_an_object() -> None:
    for labels in ("none", {"none": {}}, RemoveLabels()):
        train = MixedScans(None, [cast(), cast()], 1, labels, epoch_size=2)
        assert (train.collate([train[0]])["label"] == IGNORE).all()


def test_what_cannot_be_pasted_says_why() -> None:
    real = [cast([car(8, 2)])]
    with pytest.raises(ConfigError, match=r"count=.*of .*\(\['Car'\]\)"):
        make_policy(PasteObjects(count={"Van": 2}), real=real, fields=FIELDS)
    real[0].reflectance = real[0].reflectance * 253 + 2
    with pytest.raises(ConfigError) as caught:
        make_policy("paste", real=real, fields=FIELDS)
    assert "; expected 0 to 1. bank=" in str(caught.value)
