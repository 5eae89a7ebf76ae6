"""WaffleIron's own dataset, collate code and script on mixed scans: WAFFLEIRON_ROOT is a
checkout."""

import re
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from checkouts import checkout
from launched import clone, epochs, launched
from lidar_synth.integrations.waffleiron import NAME, register
from streets import semantic_kitti, synthetic
from torch.utils.data import DataLoader

from lidar_synth.errors import ConfigError
from lidar_synth.formats import open_scans
from lidar_synth.mixing.settings import VARIABLE

ROOT = checkout("WAFFLEIRON_ROOT", "WaffleIron")
sys.path.insert(0, str(ROOT))
REAL = 6
EXTRA = 4
BATCH = 2
CONFIG = yaml.safe_load((ROOT / "configs/WaffleIron-48-256__kitti.yaml").read_text())


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Real and synthetic scans, and the settings of a mixture."""
    root = tmp_path_factory.mktemp("waffleiron")
    semantic_kitti(root / "sk" / "dataset", REAL)
    (root / "sk/dataset/sequences/08").symlink_to("00")
    synthetic(root / "synthetic", 11)
    (root / "mix.yaml").write_text(
        yaml.safe_dump({"synthetic": str(root / "synthetic"), "ratio": 0.4, "seed": 3})
    )
    return root


@pytest.fixture
def mixed(made: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setenv(VARIABLE, str(made / "mix.yaml"))
    return dataset(NAME, made)


def dataset(name: str, made: Path, phase: str = "train") -> Any:
    """A dataset as ``launch_train.py`` makes it."""
    register()
    import datasets

    return datasets.LIST_DATASETS[name](
        phase=phase,
        rootdir=str(made / "sk"),
        input_feat=CONFIG["embedding"]["input_feat"],
        voxel_size=CONFIG["embedding"]["voxel_size"],
        num_neighbors=CONFIG["embedding"]["neighbors"],
        dim_proj=CONFIG["waffleiron"]["dim_proj"],
        grids_shape=CONFIG["waffleiron"]["grids_size"],
        fov_xyz=CONFIG["waffleiron"]["fov_xyz"],
    )


def test_two_epochs_see_exactly_the_planned_scans(mixed: Any) -> None:
    import datasets

    seen = []
    for epoch in (0, 1):
        mixed.set_epoch(epoch)
        loader = DataLoader(
            mixed, BATCH, shuffle=True, num_workers=2, collate_fn=datasets.Collate()
        )
        names = [name for batch in loader for name in batch["filename"]]
        assert Counter(name.startswith("synthetic/") for name in names) == {
            False: REAL,
            True: EXTRA,
        }
        plan = mixed.mixed.plan(epoch)
        wanted = {f"synthetic/{number}" for number in plan.index[plan.domain]}
        assert {name for name in names if name.startswith("synthetic/")} == wanted
        seen.append(wanted)
    assert not seen[0] & seen[1]


def test_real_samples_are_the_trainers_own(mixed: Any, made: Path) -> None:
    own = dataset("semantic_kitti", made)
    for position in (i for i in range(len(mixed)) if not mixed.mixed.domain(i)):
        for mine, theirs in zip(
            mixed.load_pc(position), own.load_pc(mixed.mixed[position]), strict=True
        ):
            assert np.array_equal(mine, theirs) and getattr(
                mine, "dtype", None
            ) == getattr(theirs, "dtype", None)


def test_labels_arrive_in_the_trainers_ids(mixed: Any, made: Path) -> None:
    source = open_scans(made / "synthetic")
    for position in (i for i in range(len(mixed)) if mixed.mixed.domain(i)):
        points, labels, _ = mixed.load_pc(position)
        scan = source[int(mixed.mixed.plan().index[position])]
        assert labels.dtype == np.int32 and scan.label is not None
        assert np.array_equal(labels, scan.label.astype(np.int32))
        assert np.array_equal(points[:, :3], scan.points) and np.array_equal(
            points[:, 3], scan.reflectance
        )


def test_validation_is_the_trainers_own(mixed: Any, made: Path) -> None:
    validation = dataset(NAME, made, "val")
    assert len(validation) == REAL and validation.mixed is None


def test_missing_and_unlabelled_mixtures_are_refused(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    with pytest.raises(ConfigError, match=VARIABLE):
        dataset(NAME, made)
    bare = synthetic(tmp_path / "bare", 3, labels=False)
    for labels in ("generated", "none"):
        (tmp_path / "mix.yaml").write_text(
            yaml.safe_dump({"synthetic": str(bare), "labels": labels})
        )
        monkeypatch.setenv(VARIABLE, str(tmp_path / "mix.yaml"))
        with pytest.raises(ConfigError, match="labels"):
            dataset(NAME, made)


def configure(made: Path, out: Path, last: int) -> list[str | Path]:
    """Arguments of ``launch_train.py``: the stock configuration with fewer layers, channels and
    points.

    Its CutMix counts the instances of the whole dataset, so that it cannot be on here.
    """
    config = CONFIG | {
        "dataloader": {"batch_size": BATCH, "num_workers": 1, "max_points": 2000}
    }
    config["waffleiron"] = config["waffleiron"] | {"depth": 3, "nb_channels": 16}
    config["augmentations"] = config["augmentations"] | {"instance_cutmix": False}
    config["scheduler"] = config["scheduler"] | {"max_epoch": last, "epoch_warmup": 0.5}
    (out / "config.yaml").write_text(yaml.safe_dump(config))
    arguments = [
        "launch_train.py",
        "--dataset",
        NAME,
        "--path_dataset",
        made / "sk",
        "--gpu",
        "0",
    ]
    return [*arguments, "--config", out / "config.yaml", "--log_path", out / "log"]


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_its_own_script_trains_and_resumes_from_our_launcher(
    made: Path, tmp_path: Path, mixed: Any
) -> None:
    """``launch_train.py`` as a user types it, with validation; the resumed run sees the samples of
    its epoch."""
    for number, more in enumerate(([], ["--restart"])):
        arguments = [*configure(made, tmp_path, number + 1), *more]
        said = launched("waffleiron", *arguments, cwd=ROOT, mixture=made / "mix.yaml")
        expected = (number, REAL + EXTRA, EXTRA, mixed.mixed.plan(number).hash[:16])
        assert epochs(said)[-1] == expected
        assert (
            f"Validation: {number}/{number + 1} epochs" in said
            and "Finished Training" in said
        )
        losses = [float(value) for value in re.findall(r"Loss = (\S+)", said)]
        assert len(losses) >= 2 and np.isfinite(losses).all()
    assert (tmp_path / "log" / "ckpt_last.pth").is_file()


@pytest.mark.slow
def test_a_map_of_classes_that_does_not_fit_is_refused_before_training(
    made: Path, tmp_path: Path
) -> None:
    tree = clone(ROOT, tmp_path / "clone")
    labels = tree / "datasets" / "semantic-kitti.yaml"
    merged = yaml.safe_load(labels.read_text())
    merged["learning_map"][10] = 4
    labels.write_text(yaml.safe_dump(merged))
    said = launched(
        "waffleiron",
        *configure(made, tmp_path, 1),
        cwd=tree,
        mixture=made / "mix.yaml",
        status=1,
    )
    assert (
        "lidar_synth: a map of classes with 10: 4" in said and "Traceback" not in said
    )
