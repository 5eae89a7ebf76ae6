# ruff: noqa: E402 - imports wait for what they need
"""Open3D-ML's own dataset and loader code on mixed scans: OPEN3D_ML_ROOT is a checkout."""

import sys
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from checkouts import bare_package, checkout, stand_in
from streets import semantic_kitti, synthetic

ROOT = checkout("OPEN3D_ML_ROOT", "Open3D-ML")
for library in ("sklearn", "addict"):
    pytest.importorskip(library, reason=f"{library} is not installed")
sys.path.append(str(ROOT))
stand_in("open3d", _build_config=defaultdict(bool))
for name in ("open3d.core", "open3d.ml", "open3d.ml.contrib"):
    stand_in(name)
bare_package("ml3d.torch", ROOT / "ml3d" / "torch")
bare_package("ml3d.torch.dataloaders", ROOT / "ml3d" / "torch" / "dataloaders")
bare_package("ml3d.datasets", ROOT / "ml3d" / "datasets")

from lidar_synth.integrations.mixture import EpochLoader
from lidar_synth.integrations.open3d_ml import dataset_class, tell_epochs
from ml3d.datasets.samplers import SemSegRandomSampler
from ml3d.datasets.semantickitti import SemanticKITTI
from ml3d.torch.dataloaders.torch_dataloader import TorchDataloader

from lidar_synth.errors import ConfigError, LibraryError
from lidar_synth.formats import open_scans

REAL, EXTRA = 6, 4


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make(tmp_path_factory.mktemp("open3d"))


def make(root: Path) -> Path:
    """Real and synthetic scans."""
    semantic_kitti(root / "sk" / "dataset", REAL)
    synthetic(root / "synthetic", 11)
    return root


def build(made: Path, **options: Any) -> Any:
    mixture = {"synthetic": str(made / "synthetic"), "ratio": 0.4, "seed": 3}
    given = {"mixture": mixture, "training_split": ["00"], "validation_split": ["00"]} | options
    return dataset_class("ml3d.datasets")(str(made / "sk"), **given)


def both(made: Path) -> tuple[Any, Any]:
    """The trainer's own training set and ours, of the same real scans; tools/bench/trainers.py times them."""
    own = SemanticKITTI(str(made / "sk"), training_split=["00"])
    return own.get_split("training"), build(made).get_split("training")


def test_two_epochs_see_exactly_the_planned_scans(made: Path) -> None:
    assert SemSegRandomSampler is not None
    split, seen = build(made).get_split("training"), []
    data = TorchDataloader(dataset=split, use_cache=False)
    loader = EpochLoader(data, batch_size=2, shuffle=True, num_workers=2, persistent_workers=True, collate_fn=list)
    for epoch in (0, 1):
        names = [sample["attr"]["name"] for batch in loader for sample in batch]
        assert Counter(n.startswith("synthetic_") for n in names) == {False: REAL, True: EXTRA}
        made_plan = split.mixed.plan(epoch)
        wanted = {f"synthetic_{n}" for n in made_plan.index[made_plan.domain]}
        assert {n for n in names if n.startswith("synthetic_")} == wanted
        seen.append(wanted)
    assert not seen[0] & seen[1]


def test_real_samples_are_the_trainers_own(made: Path) -> None:
    own, split = both(made)
    for position in (i for i in range(len(split)) if not split.mixed.domain(i)):
        mine, theirs = split.get_data(position), own.get_data(split.mixed[position])
        assert all(np.array_equal(mine[k], theirs[k]) and mine[k].dtype == theirs[k].dtype for k in theirs)
        assert split.get_attr(position)["name"] == own.get_attr(split.mixed[position])["name"]


def test_labels_arrive_in_the_trainers_ids(made: Path) -> None:
    split, source = build(made).get_split("training"), open_scans(made / "synthetic")
    for position in (i for i in range(len(split)) if split.mixed.domain(i)):
        data, scan = split.get_data(position), source[int(split.mixed.plan().index[position])]
        assert scan.label is not None and data["label"].dtype == np.int32 and data["feat"].shape == (len(scan), 1)
        assert np.array_equal(data["label"], np.where(scan.label == 255, 0, scan.label.astype(int) + 1))
        data["point"][:] = 0  # a sample is memory of its own
        assert np.array_equal(split.get_data(position)["point"], scan.points)


def test_its_cache_by_name_is_refused(made: Path) -> None:
    """Trap: it would give the first epoch's scans for ever."""
    with pytest.raises(ConfigError, match="use_cache=True"):
        build(made, use_cache=True)


def test_unlabelled_scans_are_refused(made: Path, tmp_path: Path) -> None:
    bare = str(synthetic(tmp_path / "bare", 3, labels=False))
    with pytest.raises(ConfigError, match="a model or bank with labels"):
        build(made, mixture={"synthetic": bare}).get_split("training")
    with pytest.raises(ConfigError, match="is NaN"):
        build(made, mixture={"synthetic": bare, "labels": "none"})


def test_the_pipeline_tells_the_epoch() -> None:
    stand_in("ml3d.torch.pipelines")
    pipeline = stand_in("ml3d.torch.pipelines.semantic_segmentation")  # which needs Open3D and its models
    tell_epochs("ml3d.torch.pipelines")
    assert pipeline.DataLoader is EpochLoader
    with pytest.raises(LibraryError, match="nowhere cannot be imported"):
        tell_epochs("nowhere")


def test_validation_is_the_trainers_own(made: Path) -> None:
    split = build(made).get_split("validation")
    assert len(split) == REAL and not hasattr(split, "mixed")
