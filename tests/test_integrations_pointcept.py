# ruff: noqa: E402, NPY002 - imports wait for what they need; trainers draw from numpy's global
# generator
"""Pointcept's own dataset, transforms, collate code and ``tools/train.py`` on mixed scans.

POINTCEPT_ROOT is a checkout; ``pointcept_cpu`` says how it runs without a GPU.
"""

import pickle
import re
import sys
from collections import Counter
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from checkouts import SCRIPTS, checkout, needs, run_script
from layouts import write_all
from streets import semantic_kitti, street, synthetic
from torch.utils.data import DataLoader

ROOT = checkout("POINTCEPT_ROOT", "Pointcept")
needs(
    "spconv",
    "torch_geometric",
    "timm",
    "peft",
    "wandb",
    "transformers",
    "einops",
    "termcolor",
    "addict",
    "torchvision",
)
sys.path.insert(0, str(SCRIPTS))
from pointcept_cpu import prepare

prepare(ROOT)

import lidar_synth.integrations.pointcept as adapter
from lidar_synth.integrations.folders import export_mixture
from pointcept.datasets.builder import build_dataset
from pointcept.datasets.utils import point_collate_fn
from pointcept.engines.hooks.builder import HOOKS
from pointcept.utils.config import Config

from lidar_synth.datasets.classes import IGNORE
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.formats import open_scans
from lidar_synth.mixing import MixedScans

REAL = 6
EXTRA = 4
VALIDATION = 2
STOCK = ROOT / "configs" / "semantic_kitti" / "semseg-spunet-v1m1-0-base.py"
SONATA = (
    Path(__file__).parent.parent
    / "configs"
    / "pointcept"
    / "pretrain_sonata_semantickitti.py"
)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make(tmp_path_factory.mktemp("pointcept"))


def make(root: Path) -> Path:
    """Real and synthetic scans."""
    for sequence in range(1, 22):
        (root / "sk" / "dataset" / "sequences" / f"{sequence:02d}" / "velodyne").mkdir(
            parents=True
        )
    semantic_kitti(root / "sk" / "dataset", REAL)
    scans = [street(100 + i) for i in range(VALIDATION)]
    write_all("semantic_kitti", root / "sk" / "dataset", scans, sequence="08")
    synthetic(root / "synthetic", 11)
    return root


def build(
    made: Path, kind: str = "MixedSemanticKITTI", stock: bool = True, **options: Any
) -> Any:
    loaded = Config.fromfile(str(STOCK))
    train = loaded.data.train.to_dict() | {"type": kind, "data_root": str(made / "sk")}
    if kind == "MixedSemanticKITTI":
        train["mixture"] = {
            "synthetic": str(made / "synthetic"),
            "ratio": 0.4,
            "seed": 3,
        }
    if not stock:
        train["transform"] = []
    return build_dataset(train | options)


def both(made: Path) -> tuple[Any, Any]:
    """The trainer's own training set and ours, of the same real scans; tools/bench/trainers.py
    times them."""
    return build(made, "SemanticKITTIDataset"), build(made)


def test_two_epochs_see_exactly_the_planned_scans(made: Path) -> None:
    """In the order in which Pointcept's training loop does it: the loader begins before any hook of
    the epoch."""
    dataset = build(made, stock=False)
    loader = DataLoader(
        dataset,
        batch_size=2,
        shuffle=True,
        num_workers=2,
        persistent_workers=True,
        collate_fn=list,
    )
    trainer = SimpleNamespace(train_loader=loader, start_epoch=0, epoch=0)
    hook = HOOKS.build({"type": "SynthEpoch"})
    hook.trainer = trainer
    hook.before_train()
    assert (
        len(trainer.train_loader) == len(loader)
        and trainer.train_loader.batch_size == 2
    )
    seen = []
    for trainer.epoch in (0, 1, 5):
        names = [sample["name"] for batch in trainer.train_loader for sample in batch]
        assert Counter(n.startswith("synthetic_") for n in names) == {
            False: REAL,
            True: EXTRA,
        }
        made_plan = dataset.mixed.plan(trainer.epoch)
        wanted = {f"synthetic_{n:06d}" for n in made_plan.index[made_plan.domain]}
        assert {n for n in names if n.startswith("synthetic_")} == wanted
        seen.append(wanted)
    assert not seen[0] & seen[1]


def test_each_pass_of_a_loop_is_an_epoch_of_the_mixture(made: Path) -> None:
    """Trap: with ``epoch=6, eval_epoch=2`` Pointcept's own loop counts two epochs, each of three
    passes."""
    ratios = [1.0, 0.4, 0.4, 0.0, 0.4, 0.0]
    mixture = {"synthetic": str(made / "synthetic"), "ratio": ratios, "epoch_size": 5}
    dataset = build(made, stock=False, loop=3, mixture=mixture)
    loader = DataLoader(
        dataset, 5, num_workers=1, persistent_workers=True, collate_fn=list
    )
    trainer = SimpleNamespace(epoch=0)
    shares = []
    for trainer.epoch in (0, 1):
        for batch in adapter.EpochOf(loader, trainer):
            shares.append(sum(s["name"].startswith("synthetic_") for s in batch) / 5)
    assert shares == ratios
    assert sum(map(dataset.domain, range(15))) == 2


def test_a_process_for_another_gpu_registers_the_dataset() -> None:
    """Trap: Pointcept runs ``custom_imports`` where it reads the configuration's file, and sends
    other processes the configuration as a pickle."""
    config = Config.fromfile(str(STOCK))
    sent = pickle.dumps(config)
    assert adapter.__name__.encode() in sent
    read = pickle.loads(sent)
    assert (read.data, read.filename) == (config.data, config.filename)


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
    dataset = build(made, stock=False)
    source = open_scans(made / "synthetic")
    for position in (i for i in range(len(dataset)) if dataset.domain(i)):
        data = dataset[position]
        scan = source[int(dataset.mixed.plan().index[position])]
        assert np.array_equal(data["coord"], scan.points) and data[
            "strength"
        ].shape == (
            len(scan),
            1,
        )
        assert data["segment"].dtype == np.int32
        assert scan.label is not None
        assert np.array_equal(
            data["segment"], np.where(scan.label == IGNORE, -1, scan.label.astype(int))
        )


def test_batches_of_both_kinds_through_the_trainers_transforms_and_mix3d(
    made: Path,
) -> None:
    """Same keys in every sample, or its collate fails; labels stay with their points after grid
    sampling."""
    dataset = build(made)
    loader = DataLoader(
        dataset, batch_size=5, collate_fn=partial(point_collate_fn, mix_prob=0.8)
    )
    for batch in loader:
        assert (
            batch["feat"].shape == (len(batch["coord"]), 4)
            and batch["segment"].max() <= 18
        )
        assert (batch["segment"] >= 0).any() and len(batch["segment"]) == len(
            batch["coord"]
        )
    walls = [dataset[i] for i in range(len(dataset)) if dataset.domain(i)]
    for sample in walls:
        road = sample["coord"][sample["segment"] == 8, 2]
        assert len(road) and road.std() < 0.1  # the road is still where it was labelled


def test_a_synthetic_scan_without_labels_never_becomes_cars(
    made: Path, tmp_path: Path
) -> None:
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


def test_the_hook_finds_mixtures_wherever_pointcept_puts_them(made: Path) -> None:
    dataset = build(made)
    for loader in (
        SimpleNamespace(dataset=dataset),
        SimpleNamespace(dataset=SimpleNamespace(datasets=[dataset])),  # ConcatDataset
        SimpleNamespace(datasets=[dataset]),  # MultiDatasetDataloader
    ):
        assert adapter.mixtures(loader) == [dataset]
    hook = HOOKS.build({"type": "SynthEpoch"})
    hook.trainer = SimpleNamespace(
        train_loader=SimpleNamespace(dataset=build(made, "SemanticKITTIDataset"))
    )
    with pytest.raises(ConfigError, match="the hook SynthEpoch without a mixture"):
        hook.before_train()


def test_pretraining_takes_scans_without_labels(made: Path, tmp_path: Path) -> None:
    bare = synthetic(tmp_path / "bare", 3, labels=False)
    transform = [{"type": "ToTensor"}, {"type": "Collect", "keys": ["coord", "name"]}]
    for labels in ("none", "ignore", {"none": {}}):
        mixture = {"synthetic": str(bare), "ratio": 0.4, "labels": labels}
        dataset = build(made, mixture=mixture, transform=transform)
        position = next(i for i in range(len(dataset)) if dataset.domain(i))
        assert (dataset.get_data(position)["segment"] == -1).all() and len(
            dataset[position]["coord"]
        )
        with pytest.raises(ConfigError, match="is NaN"):
            build(
                made,
                mixture=mixture,
                transform=[{"type": "Collect", "keys": "segment"}],
            )


def test_a_map_of_classes_that_does_not_fit_is_refused(
    made: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    merged = adapter.SemanticKITTIDataset.get_learning_map(-1) | {10: 4}
    monkeypatch.setattr(
        adapter.SemanticKITTIDataset,
        "get_learning_map",
        staticmethod(lambda ignore: merged),
    )
    with pytest.raises(ConfigError, match="a map of classes with 10: 4"):
        build(made)


def test_its_own_dataset_reads_an_exported_mixture(made: Path, tmp_path: Path) -> None:
    """Trap: it lists all sequences, also those that the export does not have."""
    real, synth = open_scans(made / "sk" / "dataset"), open_scans(made / "synthetic")
    mixed = MixedScans(real, synth, epoch_size=5, to_sample=lambda scan, rng: scan)
    export_mixture(mixed, tmp_path / "dataset", "semantic_kitti", progress=False)
    stock = build(made, "SemanticKITTIDataset", stock=False, data_root=str(tmp_path))
    assert len(stock) == 5
    assert np.array_equal(stock[0]["coord"], mixed[0].points)


def test_invalid_settings_are_refused(made: Path) -> None:
    for option in ("cache", "test_mode"):
        with pytest.raises(ConfigError, match="training without a cache"):
            build(made, **{option: True})
    with pytest.raises(ConfigError, match="LIDAR_SYNTH_MIX"):
        build(made, mixture=None)


SMALL = """
seed, batch_size, num_worker, mix_prob, enable_wandb = 1, 2, 2, 0, False
epoch, eval_epoch = {epochs}, {epochs}
data = dict(train=dict(data_root={data!r}, mixture=dict(
    synthetic={synthetic!r}, ratio={ratio}, seed=3, labels={labels!r})))
"""
SEGMENTATION = """
_base_ = [{stock!r}]
custom_imports = dict(imports=["lidar_synth.integrations.pointcept"], allow_failed_imports=False)
hooks = [dict(type="SynthEpoch"), *[dict(type=name) for name in (
    "CheckpointLoader", "ModelHook", "IterationTimer", "InformationWriter", "SemSegEvaluator",
    "CheckpointSaver", "PreciseEvaluator")]]
hooks[-2]["save_freq"] = 1
model = dict(backbone=dict(channels=(8,) * 8, layers=(1,) * 8))
{small}
data["train"]["type"] = "MixedSemanticKITTI"
data |= dict(val=dict(data_root={data!r}), test=dict(data_root={data!r}))
"""
PRETRAINING = """
_base_ = [{stock!r}]
model = dict(backbone=dict(
    enc_depths=(1,) * 5, enc_channels=(12, 12, 24, 24, 48), enc_num_head=(1,) * 5,
    enc_patch_size=(64,) * 5, enable_flash=False),
    head_in_channels=96, head_hidden_channels=32, head_embed_channels=16, head_num_prototypes=32)
param_dicts = [dict(keyword="enc0", lr=0.004)]
scheduler = dict(max_lr=[0.004, 0.004])
{small}
data["train"]["split"] = ["train"]
"""


def train(made: Path, text: str, out: Path, *options: str, **values: Any) -> str:
    """What ``tools/train.py`` says with a configuration of the test, as a user types it."""
    data = {"data": str(made / "sk"), "synthetic": str(made / "synthetic")}
    values = data | {"ratio": 0.4, "labels": "generated"} | values
    out.mkdir(parents=True, exist_ok=True)
    (out / "config.py").write_text(text.format(small=SMALL.format(**values), **values))
    return run_script(
        SCRIPTS / "pointcept_cpu.py",
        "tools/train.py",
        "--config-file",
        str(out / "config.py"),
        "--options",
        f"save_path={out / 'run'}",
        *options,
        cwd=ROOT,
    )


def samples(said: str) -> dict[int, list[str]]:
    """The training samples of each epoch, in the order of their names."""
    found: dict[int, list[str]] = {}
    for epoch, name in re.findall(r"epoch (\d+) sample (\S+)", said):
        found.setdefault(int(epoch), []).append(name)
    return {epoch: sorted(names) for epoch, names in found.items()}


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_its_own_script_trains_evaluates_and_resumes_with_the_hook_first(
    made: Path, tmp_path: Path
) -> None:
    """SparseUNet with real spconv. Pointcept saves at the end of an epoch, so a run resumes only at
    the start of one.

    This does not show: pointops and pointgroup_ops, which SparseUNet does not use, and mixed
    precision.
    """
    values = {"stock": str(STOCK), "epochs": 3}
    said = train(made, SEGMENTATION, tmp_path, **values)
    seen = samples(said)
    assert sorted(seen) == [0, 1, 2]
    for names in seen.values():
        assert Counter(n.startswith("synthetic_") for n in names) == {
            False: REAL,
            True: EXTRA,
        }
    # Of 11.
    assert (
        len({n for names in seen.values() for n in names if n.startswith("synthetic_")})
        == 3 * EXTRA - 1
    )
    losses = [float(loss) for loss in re.findall(r"loss: (\S+) Lr", said)]
    assert len(losses) == 15 and np.isfinite(losses).all()
    # After each epoch, and the best.
    assert len(re.findall(r"Val result: mIoU/mAcc/allAcc [\d.]+/", said)) == 4
    checkpoint = tmp_path / "run" / "model" / "epoch_2.pth"
    rest = train(
        made, SEGMENTATION, tmp_path, "resume=True", f"weight={checkpoint}", **values
    )
    assert samples(rest) == {2: seen[2]}


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_sonata_pretrains_on_scans_without_labels(made: Path, tmp_path: Path) -> None:
    """Its stock configuration with the data of ours and a smaller network.

    This does not show: flash attention, and pointops, for which tools/stand_ins has a function of
    torch.
    """
    values = {
        "synthetic": str(synthetic(tmp_path / "bare", 2 * REAL, labels=False)),
        "labels": "none",
        "ratio": 0.5,
    }
    said = train(made, PRETRAINING, tmp_path, stock=str(SONATA), epochs=2, **values)
    seen = samples(said)
    for epoch in (0, 1):
        assert Counter(n.startswith("synthetic_") for n in seen[epoch]) == {
            False: REAL,
            True: REAL,
        }
    assert set(seen[0]) & set(seen[1]) == {f"00_{i:06d}" for i in range(REAL)}
    losses = [float(loss) for loss in re.findall(r" loss: (\S+) ", said)]
    assert (
        losses
        and np.isfinite(losses).all()
        and (tmp_path / "run" / "model" / "model_last.pth").exists()
    )
