# ruff: noqa: E402, NPY002 - imports wait for what they need; trainers draw from numpy's global generator
"""Pointcept's own dataset, transforms and collate code on mixed scans: POINTCEPT_ROOT is a checkout."""

import sys
from collections import Counter
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from checkouts import bare_package, checkout, stand_in
from streets import semantic_kitti, synthetic
from torch.utils.data import DataLoader

ROOT = checkout("POINTCEPT_ROOT", "Pointcept")
for library in ("termcolor", "addict"):
    pytest.importorskip(library, reason=f"{library} is not installed")
sys.path.append(str(ROOT))
stand_in("torchvision")
modes = SimpleNamespace(BILINEAR="bilinear", BICUBIC="bicubic", NEAREST="nearest")
stand_in("torchvision.transforms", InterpolationMode=modes)
for name in ("open3d", "torchvision.transforms.transforms", "torch_scatter", "SharedArray", "timm", "timm.layers"):
    stand_in(name)
bare_package("pointcept.models", ROOT / "pointcept" / "models")
bare_package("pointcept.engines.hooks", ROOT / "pointcept" / "engines" / "hooks")
bare_package("pointcept.datasets", ROOT / "pointcept" / "datasets")

import lidar_synth.integrations.pointcept as adapter
from pointcept.datasets.builder import build_dataset
from pointcept.datasets.utils import point_collate_fn
from pointcept.engines.hooks.builder import HOOKS
from pointcept.utils.config import Config

from lidar_synth.datasets.classes import IGNORE
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.formats import open_scans

REAL, EXTRA = 6, 4


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make(tmp_path_factory.mktemp("pointcept"))


def make(root: Path) -> Path:
    """Real and synthetic scans."""
    for sequence in ("01", "02", "03", "04", "05", "06", "07", "09", "10"):
        (root / "sk" / "dataset" / "sequences" / sequence / "velodyne").mkdir(parents=True)
    semantic_kitti(root / "sk" / "dataset", REAL)
    synthetic(root / "synthetic", 11)
    return root


def build(made: Path, kind: str = "MixedSemanticKITTI", stock: bool = True, **options: Any) -> Any:
    loaded = Config.fromfile(str(ROOT / "configs/semantic_kitti/semseg-spunet-v1m1-0-base.py"))
    train = loaded.data.train.to_dict() | {"type": kind, "data_root": str(made / "sk")}
    if kind == "MixedSemanticKITTI":
        train["mixture"] = {"synthetic": str(made / "synthetic"), "ratio": 0.4, "seed": 3}
    if not stock:
        train["transform"] = []
    return build_dataset(train | options)


def both(made: Path) -> tuple[Any, Any]:
    """The trainer's own training set and ours, of the same real scans; tools/bench/trainers.py times them."""
    return build(made, "SemanticKITTIDataset"), build(made)


def test_two_epochs_see_exactly_the_planned_scans(made: Path) -> None:
    dataset = build(made, stock=False)
    loader = DataLoader(dataset, batch_size=2, shuffle=True, num_workers=2, persistent_workers=True, collate_fn=list)
    trainer = SimpleNamespace(train_loader=loader, start_epoch=0, epoch=0)
    hook = HOOKS.build({"type": "SynthEpoch"})
    hook.trainer = trainer
    hook.before_train()
    seen = []
    for epoch in (0, 1):
        trainer.epoch = epoch
        names = [sample["name"] for batch in loader for sample in batch]
        assert Counter(n.startswith("synthetic_") for n in names) == {False: REAL, True: EXTRA}
        made_plan = dataset.mixed.plan(epoch)
        wanted = {f"synthetic_{n:06d}" for n in made_plan.index[made_plan.domain]}
        assert {n for n in names if n.startswith("synthetic_")} == wanted
        seen.append(wanted)
        hook.after_epoch()
    assert not seen[0] & seen[1]


def test_real_samples_are_the_trainers_own(made: Path) -> None:
    theirs, ours = both(made)
    for position in (i for i in range(len(ours)) if not ours.domain(i)):
        np.random.seed(7)
        import random

        random.seed(7)
        mine = ours[position]
        np.random.seed(7)
        random.seed(7)
        own = theirs[ours.mixed[position]]
        assert set(mine) == set(own) and all(torch.equal(mine[k], own[k]) for k in mine)


def test_labels_arrive_in_the_trainers_ids(made: Path) -> None:
    dataset, source = build(made, stock=False), open_scans(made / "synthetic")
    for position in (i for i in range(len(dataset)) if dataset.domain(i)):
        data = dataset[position]
        scan = source[int(dataset.mixed.plan().index[position])]
        assert np.array_equal(data["coord"], scan.points) and data["strength"].shape == (len(scan), 1)
        assert data["segment"].dtype == np.int32
        assert scan.label is not None
        assert np.array_equal(data["segment"], np.where(scan.label == IGNORE, -1, scan.label.astype(int)))


def test_batches_of_both_kinds_through_the_trainers_transforms_and_mix3d(made: Path) -> None:
    """Same keys in every sample, or its collate fails; labels stay with their points after grid sampling."""
    dataset = build(made)
    loader = DataLoader(dataset, batch_size=5, collate_fn=partial(point_collate_fn, mix_prob=0.8))
    for batch in loader:
        assert batch["feat"].shape == (len(batch["coord"]), 4) and batch["segment"].max() <= 18
        assert (batch["segment"] >= 0).any() and len(batch["segment"]) == len(batch["coord"])
    walls = [dataset[i] for i in range(len(dataset)) if dataset.domain(i)]
    for sample in walls:
        road = sample["coord"][sample["segment"] == 8, 2]
        assert len(road) and road.std() < 0.1  # the road is still where it was labelled


def test_a_synthetic_scan_without_labels_never_becomes_cars(made: Path, tmp_path: Path) -> None:
    """Trap: what has no ``.label`` is read as zeros, class car."""
    bare = synthetic(tmp_path / "bare", 3, labels=False)
    with pytest.raises(ConfigError, match="a model or bank with labels"):
        build(made, mixture={"synthetic": str(bare)})
    with pytest.raises(ConfigError, match="is NaN"):
        build(made, mixture={"synthetic": str(bare), "labels": "ignore"})
    dataset = build(made, stock=False)
    position = next(i for i in range(len(dataset)) if dataset.domain(i))
    scan = dataset.mixed[position]
    scan.label[:] = IGNORE
    with pytest.raises(DataError, match="no valid label"):
        adapter.class_ids(scan, dataset._ids)


def test_a_map_of_classes_that_does_not_fit_is_refused(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    merged = adapter.SemanticKITTIDataset.get_learning_map(-1) | {10: 4}
    monkeypatch.setattr(adapter.SemanticKITTIDataset, "get_learning_map", staticmethod(lambda ignore: merged))
    with pytest.raises(ConfigError, match="a map of classes with 10: 4"):
        build(made)


def test_invalid_settings_are_refused(made: Path) -> None:
    for option in ("cache", "test_mode"):
        with pytest.raises(ConfigError, match="training without a cache"):
            build(made, **{option: True})
    with pytest.raises(ConfigError, match="LIDAR_SYNTH_MIX"):
        build(made, mixture=None)
