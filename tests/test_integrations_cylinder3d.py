# ruff: noqa: E402, NPY002 - imports wait for what they need; Cylinder3D draws from numpy's global
# generator
"""Cylinder3D's own voxels, augmentation, collate code and script on mixed scans: CYLINDER3D_ROOT is
a checkout."""

import os
import re
import sys
from collections import Counter
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
import yaml
from checkouts import checkout
from launched import epochs, launched
from lidar_synth.integrations.removed import provide
from streets import semantic_kitti, synthetic

ROOT = checkout("CYLINDER3D_ROOT", "Cylinder3D")
sys.path.append(str(ROOT))
provide("numpy.int")  # as the launcher does

from dataloader.dataset_semantickitti import collate_fn_BEV, get_model_class
from dataloader.pc_dataset import get_pc_model_class
from lidar_synth.integrations.cylinder3d import NAME, register
from lidar_synth.integrations.mixture import EpochLoader

from lidar_synth.errors import ConfigError
from lidar_synth.formats import open_scans
from lidar_synth.mixing.settings import VARIABLE

REAL = 6
EXTRA = 4
LABELS = str(ROOT / "config/label_mapping/semantic-kitti.yaml")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make(tmp_path_factory.mktemp("cylinder3d"))


def make(root: Path) -> Path:
    """Real and synthetic scans, and the settings of a mixture."""
    semantic_kitti(root / "sk", REAL)
    for sequence in ("01", "02", "03", "04", "05", "06", "07", "09", "10"):
        (root / "sk" / "sequences" / sequence / "velodyne").mkdir(parents=True)
    synthetic(root / "synthetic", 11)
    (root / "mix.yaml").write_text(
        yaml.safe_dump({"synthetic": str(root / "synthetic"), "ratio": 0.4, "seed": 3})
    )
    return root


@pytest.fixture
def points(made: Path) -> Any:
    return both(made)[1]


def both(made: Path) -> tuple[Any, Any]:
    """The trainer's own training set and ours, of the same real scans; tools/bench/trainers.py
    times them."""
    register()
    options = {"imageset": "train", "return_ref": True, "label_mapping": LABELS}
    with patch.dict(os.environ, {VARIABLE: str(made / "mix.yaml")}):
        return tuple(
            get_pc_model_class(name)(f"{made}/sk/sequences", **options)
            for name in ("SemKITTI_sk", NAME)
        )


def voxels(dataset: Any, augment: bool = True) -> Any:
    options = dict.fromkeys(
        ("flip_aug", "rotate_aug", "scale_aug", "transform_aug"), augment
    )
    return get_model_class("cylinder_dataset")(
        dataset,
        [48, 36, 8],
        fixed_volume_space=True,
        ignore_label=0,
        return_test=True,
        **options,
    )


def test_two_epochs_see_exactly_the_planned_scans(made: Path, points: Any) -> None:
    loader = EpochLoader(
        voxels(points), batch_size=2, shuffle=True, num_workers=2, collate_fn=list
    )
    seen = []
    for epoch in (0, 1):
        indices = [sample[-1] for batch in loader for sample in batch]
        assert (
            sorted(indices) == list(range(REAL + EXTRA)) and points.mixed.epoch == epoch
        )
        assert Counter(points.mixed.domain(i) for i in indices) == {0: REAL, 1: EXTRA}
        made_plan = points.mixed.plan(epoch)
        seen.append(set(made_plan.index[made_plan.domain].tolist()))
    assert not seen[0] & seen[1] and len(seen[0]) == EXTRA


def test_workers_give_the_scans_of_their_epoch(made: Path, points: Any) -> None:
    source = open_scans(made / "synthetic")
    loader = EpochLoader(points, batch_size=1, num_workers=2, collate_fn=list)
    for epoch in (0, 1):
        made_plan = points.mixed.plan(epoch)
        for position, [(xyz, _, _)] in enumerate(loader):
            if made_plan.domain[position]:
                assert np.array_equal(
                    xyz, source[int(made_plan.index[position])].points
                )


def test_real_samples_are_the_trainers_own(made: Path, points: Any) -> None:
    own = both(made)[0]
    for position in (i for i in range(len(points)) if not points.mixed.domain(i)):
        for a, b in zip(points[position], own[points.mixed[position]], strict=True):
            assert a.dtype == b.dtype and np.array_equal(a, b)


def test_labels_arrive_in_the_trainers_ids(made: Path, points: Any) -> None:
    source = open_scans(made / "synthetic")
    for position in (i for i in range(len(points)) if points.mixed.domain(i)):
        xyz, label, strength = points[position]
        scan = source[int(points.mixed.plan().index[position])]
        assert (
            label.dtype == np.uint8
            and label.shape == (len(scan), 1)
            and scan.label is not None
        )
        assert np.array_equal(
            label[:, 0], np.where(scan.label == 255, 0, scan.label + 1)
        )
        assert np.array_equal(xyz, scan.points) and np.array_equal(
            strength, scan.reflectance
        )


def test_turning_in_place_does_not_reach_the_source(made: Path, points: Any) -> None:
    """Trap: Cylinder3D turns and flips the array that it is handed."""
    from lidar_synth.geometry.scan import Scan

    kept = {i: points.mixed[i] for i in range(len(points)) if points.mixed.domain(i)}
    before = {i: scan.points.copy() for i, scan in kept.items()}
    inner = points.mixed.sample
    points.mixed.sample = lambda epoch, i: kept.get(i, inner(epoch, i))
    np.random.seed(0)
    turned = voxels(points)
    for position in kept:
        turned[position]
        assert isinstance(kept[position], Scan) and np.array_equal(
            kept[position].points, before[position]
        )


def test_batches_go_through_its_collate(points: Any) -> None:
    dataset = get_model_class("cylinder_dataset")(
        points, [48, 36, 8], fixed_volume_space=True, ignore_label=0
    )
    for batch in EpochLoader(dataset, batch_size=5, collate_fn=collate_fn_BEV):
        assert batch[0].shape == (5, 3, 48, 36, 8) and (batch[1] > 0).any()


def test_validation_is_the_trainers_own(
    made: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(VARIABLE, str(made / "mix.yaml"))
    (made / "sk" / "sequences" / "08").exists() or (
        made / "sk" / "sequences" / "08"
    ).symlink_to("00")
    val = register_once()(
        f"{made}/sk/sequences", "val", return_ref=True, label_mapping=LABELS
    )
    assert len(val) == REAL and val.mixed is None


def register_once() -> Any:
    return register()


def test_a_map_of_classes_that_does_not_fit_is_refused(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its labels are a file that the configuration names: synthetic ones would keep the stock
    ids."""
    monkeypatch.setenv(VARIABLE, str(made / "mix.yaml"))
    mapping = yaml.safe_load(Path(LABELS).read_text())
    mapping["learning_map"][10] = 4
    (tmp_path / "merged.yaml").write_text(yaml.safe_dump(mapping))
    with pytest.raises(ConfigError, match="a map of classes with 10: 4"):
        register()(
            f"{made}/sk/sequences", "train", label_mapping=str(tmp_path / "merged.yaml")
        )


def test_missing_and_unlabelled_mixtures_are_refused(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    with pytest.raises(ConfigError, match=VARIABLE):
        register()(f"{made}/sk/sequences", "train", label_mapping=LABELS)
    bare = synthetic(tmp_path / "bare", 3, labels=False)
    for labels in ("generated", "none"):
        (tmp_path / "mix.yaml").write_text(
            yaml.safe_dump({"synthetic": str(bare), "labels": labels})
        )
        monkeypatch.setenv(VARIABLE, str(tmp_path / "mix.yaml"))
        with pytest.raises(ConfigError, match="labels"):
            register()(f"{made}/sk/sequences", "train", label_mapping=LABELS)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_its_own_script_trains_from_our_launcher(made: Path, tmp_path: Path) -> None:
    """The stock network on a small grid: ``train_cylinder_asym.py`` as a user types it, with
    validation."""
    for library in ("spconv", "torch_scatter", "strictyaml"):
        if not find_spec(library):
            pytest.skip(
                f"{library}, which Cylinder3D's network needs, is not installed"
            )
    (made / "sk" / "sequences" / "08").exists() or (
        made / "sk" / "sequences" / "08"
    ).symlink_to("00")
    own = yaml.safe_load((ROOT / "config/semantickitti.yaml").read_text())
    own["model_params"] |= {
        "output_shape": [48, 36, 16],
        "init_size": 4,
        "out_fea_dim": 32,
    }
    own["dataset_params"] |= {"pc_dataset_type": NAME, "label_mapping": LABELS}
    for loader in ("train_data_loader", "val_data_loader"):
        own[loader] |= {"data_path": f"{made}/sk/sequences", "num_workers": 2}
    each = (REAL + EXTRA) // 2
    model = tmp_path / "model.pt"
    own["train_params"] |= {"max_num_epochs": 2, "eval_every_n_steps": each}
    own["train_params"] |= {
        "model_load_path": str(model),
        "model_save_path": str(model),
    }
    (tmp_path / "mixed.yaml").write_text(yaml.safe_dump(own))
    arguments = ["train_cylinder_asym.py", "--config_path", tmp_path / "mixed.yaml"]
    said = launched("cylinder3d", *arguments, cwd=ROOT, mixture=made / "mix.yaml")
    assert (
        "provides numpy.int (removed in numpy 1.24), spconv (of spconv 1, by spconv 2)"
        in said
    )
    plan = both(made)[1].mixed.plan
    assert epochs(said) == [(e, REAL + EXTRA, EXTRA, plan(e).hash[:16]) for e in (0, 1)]
    losses = [
        float(value) for value in re.findall(r"epoch \d+ iter +\d+, loss: (\S+)", said)
    ]
    assert (
        len(losses) == 3
        and np.isfinite(losses).all()
        and "Current val loss" in said
        and model.is_file()
    )
