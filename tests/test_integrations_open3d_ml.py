"""Open3D's own ML part, as it is installed, on mixed scans: dataset, loader, and its pipeline with
RandLANet."""

import logging
from collections import Counter
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from launched import epochs
from lidar_synth.integrations.launcher import say_epochs
from lidar_synth.integrations.mixture import EpochLoader
from lidar_synth.integrations.open3d_ml import dataset_class
from streets import semantic_kitti, synthetic

from lidar_synth.errors import ConfigError, LibraryError
from lidar_synth.formats import open_scans

try:
    dataset_class()
except LibraryError as error:
    pytest.skip(str(error), allow_module_level=True)

import open3d.ml.torch as ml3d

REAL = 6
EXTRA = 4


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
    given = {
        "mixture": mixture,
        "training_split": ["00"],
        "validation_split": ["00"],
    } | options
    return dataset_class()(str(made / "sk"), **given)


def both(made: Path) -> tuple[Any, Any]:
    """The trainer's own training set and ours, of the same real scans; tools/bench/trainers.py
    times them."""
    own = ml3d.datasets.SemanticKITTI(str(made / "sk"), training_split=["00"])
    return own.get_split("training"), build(made).get_split("training")


def test_two_epochs_see_exactly_the_planned_scans(made: Path) -> None:
    split = build(made).get_split("training")
    seen = []
    data = ml3d.dataloaders.TorchDataloader(dataset=split, use_cache=False)
    loader = EpochLoader(
        data,
        batch_size=2,
        shuffle=True,
        num_workers=2,
        persistent_workers=True,
        collate_fn=list,
    )
    for epoch in (0, 1):
        names = [sample["attr"]["name"] for batch in loader for sample in batch]
        assert Counter(n.startswith("synthetic_") for n in names) == {
            False: REAL,
            True: EXTRA,
        }
        made_plan = split.mixed.plan(epoch)
        wanted = {f"synthetic_{n}" for n in made_plan.index[made_plan.domain]}
        assert {n for n in names if n.startswith("synthetic_")} == wanted
        seen.append(wanted)
    assert not seen[0] & seen[1]


def test_real_samples_are_the_trainers_own(made: Path) -> None:
    own, split = both(made)
    for position in (i for i in range(len(split)) if not split.mixed.domain(i)):
        mine = split.get_data(position)
        theirs = own.get_data(split.mixed[position])
        assert all(
            np.array_equal(mine[k], theirs[k]) and mine[k].dtype == theirs[k].dtype
            for k in theirs
        )
        assert (
            split.get_attr(position)["name"]
            == own.get_attr(split.mixed[position])["name"]
        )


def test_labels_arrive_in_the_trainers_ids(made: Path) -> None:
    split = build(made).get_split("training")
    source = open_scans(made / "synthetic")
    for position in (i for i in range(len(split)) if split.mixed.domain(i)):
        data = split.get_data(position)
        scan = source[int(split.mixed.plan().index[position])]
        assert (
            scan.label is not None
            and data["label"].dtype == np.int32
            and data["feat"].shape == (len(scan), 1)
        )
        assert np.array_equal(
            data["label"], np.where(scan.label == 255, 0, scan.label.astype(int) + 1)
        )
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


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_its_pipeline_trains_and_validates(
    made: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The documented lines: stock RandLANet with fewer points, two epochs, validation after
    each."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(logging.getLogger("lidar_synth"), "handlers", [])
    say_epochs()
    dataset = build(made)
    resources = Path(
        import_module(ml3d.datasets.SemanticKITTI.__module__).__file__ or ""
    ).parent.parent
    config = import_module("open3d.ml.utils").Config.load_from_file(
        str(resources / "configs/randlanet_semantickitti.yml")
    )
    model = ml3d.models.RandLANet(
        **config.model | {"in_channels": 4, "num_points": 4096}
    )
    own = config.pipeline | {
        "max_epoch": 1,
        "save_ckpt_freq": 1,
        "batch_size": 2,
        "device": "cpu",
    }
    pipeline = ml3d.pipelines.SemanticSegmentation(model, dataset=dataset, **own)
    seen: list[list[float]] = []
    log = pipeline.save_logs
    monkeypatch.setattr(
        pipeline,
        "save_logs",
        lambda *a: (seen.append([*pipeline.losses, *pipeline.valid_losses]), log(*a)),
    )
    pipeline.run_train()
    plan = dataset.get_split("training").mixed.plan
    said = epochs(capsys.readouterr().out)[:2]
    assert said == [(e, REAL + EXTRA, EXTRA, plan(e).hash[:16]) for e in (0, 1)]
    assert [len(losses) for losses in seen] == [
        (REAL + EXTRA) // 2 + REAL // 2
    ] * 2 and np.isfinite(seen).all()
    assert list(tmp_path.rglob("ckpt_00001.pth"))


ERRORS = {
    "another torch": (
        RuntimeError("Version mismatch: Open3D needs PyTorch version 1.8.*"),
        "one release of torch",
    ),
    "CUDA's operators": (
        OSError("Could not load this library: open3d_torch_ops.so"),
        r"pip install 'open3d-cpu\[ml\]'",
    ),
    "no ML part": (
        ImportError("Open3D-ML requires the 'addict' package"),
        r"pip install 'open3d\[ml\]'",
    ),
}


@pytest.mark.parametrize("name", ERRORS)
def test_a_library_that_cannot_be_used_is_explained(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What ``open3d.ml.torch`` raised in environments with these faults."""
    error, hint = ERRORS[name]

    def broken(name: str) -> Any:
        raise error

    monkeypatch.setattr("lidar_synth.integrations.open3d_ml.import_module", broken)
    with pytest.raises(
        LibraryError, match=f"torch {torch.__version__.split('+')[0]}.*{hint}"
    ):
        dataset_class.__wrapped__()


def test_validation_is_the_trainers_own(made: Path) -> None:
    split = build(made).get_split("validation")
    assert len(split) == REAL and not hasattr(split, "mixed")
