# ruff: noqa: E402 - imports wait for what they need
"""Resumed runs of mmengine's own ``Runner``, by epochs and by iterations, see the samples of an
uninterrupted run.

The network is one number, so that these tests are about data alone; the trainer's own networks run
in ``test_integrations_mmdet3d_train.py``.
"""

import json
import pickle
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip(
    "mmengine", reason="mmengine is not installed: bash tools/install_mmdet3d.sh"
)
pytest.importorskip(
    "mmcv", reason="mmcv is not installed: bash tools/install_mmdet3d.sh"
)
import mmcv_ext

mmcv_ext.install()
pytest.importorskip(
    "mmdet3d", reason="mmdet3d is not installed: bash tools/install_mmdet3d.sh"
)

import torch
from lidar_synth.integrations import mmdet3d as _  # noqa: F401 - registers its parts
from lidar_synth.integrations.mmdet3d_infos import write_infos
from lidar_synth.integrations.mmdet3d_lists import semantic_kitti_list
from lidar_synth.integrations.mmdet3d_slots import open_folder
from mmdet3d.registry import MODELS
from mmdet3d_parts import CONFIGS
from mmengine.config import Config
from mmengine.hooks import Hook
from mmengine.model import BaseModel
from mmengine.registry import init_default_scope
from mmengine.runner import Runner
from streets import semantic_kitti, synthetic

from lidar_synth.errors import ConfigError

STEPS = 4
"""Steps of an epoch: 5 real and 2 synthetic samples in batches of two, the last of them smaller."""
LOADING = [
    {"type": "LoadPointsFromFile", "coord_type": "LIDAR", "load_dim": 4, "use_dim": 4},
    {"type": "Pack3DDetInputs", "keys": ["points"], "meta_keys": ["lidar_path"]},
]


@MODELS.register_module(force=True)
class OneNumber(BaseModel):  # type: ignore[misc]
    """Its loss is the mean of its number times each scan's mean reflectance."""

    def __init__(self) -> None:
        super().__init__()
        self.number = torch.nn.Parameter(torch.ones(()))

    def forward(
        self, inputs: Any, data_samples: Any = None, mode: str = "tensor"
    ) -> Any:
        return {
            "loss": torch.stack(
                [self.number * points[:, 3].mean() for points in inputs["points"]]
            ).mean()
        }


class Seen(Hook):  # type: ignore[misc]
    """Notes each step's samples: file and mean reflectance, which tells synthetic scans apart."""

    def __init__(self) -> None:
        self.steps: dict[int, list[tuple[str, float]]] = {}

    def after_train_iter(
        self, runner: Any, batch_idx: int, data_batch: Any = None, outputs: Any = None
    ) -> None:
        named = zip(
            data_batch["data_samples"], data_batch["inputs"]["points"], strict=True
        )
        self.steps[runner.iter] = [
            (Path(s.lidar_path).name, float(p[:, 3].double().mean())) for s, p in named
        ]


@pytest.fixture(scope="module")
def listed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("resume")
    real = semantic_kitti_list(semantic_kitti(root / "sk", 5), root / "train.pkl")
    settings = {
        "synthetic": synthetic(root / "synthetic", 9),
        "ratio": 2 / 7,
        "seed": 4,
    }
    return write_infos(root / "mixed", real, settings, data_root=root / "sk")


def run(
    listed: Path, out: Path, loop: dict[str, Any], save: dict[str, Any], **options: Any
) -> Seen:
    """A training of a config as a user writes it; ``randomness`` is not set, so each run has
    another seed."""
    init_default_scope("mmdet3d")
    dataset = Config.fromfile(
        str(CONFIGS / "minkunet_semantickitti.py")
    ).train_dataloader.dataset
    dataset.update(ann_file=str(listed), pipeline=LOADING)
    loader = {
        "batch_size": 2,
        "num_workers": 1,
        "persistent_workers": True,
        "dataset": dataset,
    }
    seen = Seen()
    runner = Runner(
        model={"type": "OneNumber"},
        work_dir=str(out),
        train_cfg=loop,
        default_scope="mmdet3d",
        train_dataloader=loader
        | {
            "sampler": options.pop("sampler", {"type": "SynthSampler", "shuffle": True})
        },
        optim_wrapper={"type": "OptimWrapper", "optimizer": {"type": "SGD", "lr": 0.1}},
        default_hooks={"checkpoint": {"type": "CheckpointHook", **save}},
        experiment_name=out.name,
        custom_hooks=[{"type": "SynthEpochHook"}, seen],
        log_level="ERROR",
        **options,
    )
    runner.train()
    return seen


LOOPS = {
    "epochs": {"type": "EpochBasedTrainLoop", "max_epochs": 3},
    "iterations": {"type": "IterBasedTrainLoop", "max_iters": 3 * STEPS},
}


@pytest.fixture(scope="module")
def uninterrupted(
    listed: Path, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, tuple[Path, Seen]]:
    """A checkpoint after every step, and the samples of every step, by loop."""
    out = tmp_path_factory.mktemp("uninterrupted")
    save = {"interval": 1, "by_epoch": False}
    return {
        name: (out / name, run(listed, out / name, loop, save))
        for name, loop in LOOPS.items()
    }


@pytest.mark.parametrize("name", LOOPS)
def test_an_epoch_has_every_real_scan_and_new_synthetic_ones(
    uninterrupted: Any, name: str
) -> None:
    steps = uninterrupted[name][1].steps
    assert list(steps) == list(range(3 * STEPS))
    epochs = [
        [s for i in range(STEPS * e, STEPS * (e + 1)) for s in steps[i]]
        for e in range(3)
    ]
    assert all(len(epoch) == 7 and len(set(epoch)) == 7 for epoch in epochs)
    real = set(epochs[0]) & set(epochs[1]) & set(epochs[2])
    assert len(real) == 5 and len(set().union(*map(set, epochs)) - real) == 3 * 2
    assert epochs[0] != epochs[1]


@pytest.mark.parametrize("name", LOOPS)
@pytest.mark.parametrize(
    "done", [STEPS + 1, 2 * STEPS - 1, 2 * STEPS], ids=["middle", "last step", "end"]
)
def test_a_resumed_run_sees_the_samples_of_an_uninterrupted_one(
    listed: Path, uninterrupted: Any, tmp_path: Path, name: str, done: int
) -> None:
    saved, whole = uninterrupted[name]
    rest = run(
        listed,
        tmp_path / name,
        LOOPS[name],
        {"interval": 100},
        resume=True,
        load_from=str(saved / f"iter_{done}.pth"),
    )
    assert rest.steps == {i: samples for i, samples in whole.steps.items() if i >= done}


def test_a_schedule_trains_and_resumes_the_planned_samples(
    listed: Path, tmp_path: Path
) -> None:
    """Seven samples in each epoch: five of them synthetic, then one."""
    made = json.loads((listed.parent / "mixture.json").read_text())["settings"]
    settings = made | {"ratio": {0: 0.75, 1: 0.1}, "epoch_size": 7}
    root = listed.parents[1]
    path = write_infos(
        tmp_path / "mixed", root / "train.pkl", settings, data_root=root / "sk"
    )
    loop = {"type": "EpochBasedTrainLoop", "max_epochs": 2}
    whole = run(
        path, tmp_path / "whole", loop, {"interval": 1, "by_epoch": False}
    ).steps
    epochs = [
        [sample for i in range(4 * e, 4 * e + 4) for sample in whole[i]] for e in (0, 1)
    ]
    folder = open_folder(path.parent)
    for epoch, samples in enumerate(epochs):
        assert len(samples) == 7
        numbers = [int(name.removesuffix(".bin")) for name, mean in samples]
        wanted = folder.entries(epoch)
        assert numbers == [
            n if n < folder.real else n - folder.real for n in wanted.tolist()
        ]
    saved = str(tmp_path / "whole" / "iter_6.pth")
    rest = run(
        path, tmp_path / "rest", loop, {"interval": 9}, resume=True, load_from=saved
    )
    assert rest.steps == {i: samples for i, samples in whole.items() if i >= 6}


def test_a_run_resumed_from_an_epochs_checkpoint(
    listed: Path, uninterrupted: Any, tmp_path: Path
) -> None:
    run(
        listed, tmp_path / "first", LOOPS["epochs"] | {"max_epochs": 1}, {"interval": 1}
    )
    load = {"resume": True, "load_from": str(tmp_path / "first" / "epoch_1.pth")}
    rest = run(listed, tmp_path / "rest", LOOPS["epochs"], {"interval": 100}, **load)
    whole = uninterrupted["epochs"][1].steps
    assert rest.steps == {i: samples for i, samples in whole.items() if i >= STEPS}


def test_the_hook_asks_for_the_sampler(listed: Path, tmp_path: Path) -> None:
    for stock in ("DefaultSampler", "InfiniteSampler"):
        with pytest.raises(ConfigError, match=f"sampler {stock}.*type='SynthSampler'"):
            run(
                listed,
                tmp_path / stock,
                LOOPS["epochs"],
                {"interval": 1},
                sampler={"type": stock, "shuffle": True},
            )


class Harmful:
    def __reduce__(self) -> Any:
        return getattr, (Path, "unlink")


@pytest.mark.parametrize(
    "content", [Harmful(), {"f": Path.unlink}], ids=["another method", "a function"]
)
def test_a_checkpoint_still_cannot_name_other_functions(
    tmp_path: Path, content: Any
) -> None:
    """Reading mmengine's checkpoints is allowed for what they hold, with torch's own protection in
    force."""
    torch.save({"meta": content}, tmp_path / "a.pth")
    with pytest.raises(
        pickle.UnpicklingError, match="Weights only load failed|expected a method of"
    ):
        torch.load(tmp_path / "a.pth")
