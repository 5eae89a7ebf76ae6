"""Open3D-ML: the documented lines, with the ML part that is bundled with Open3D and its pipeline, RandLANet."""

from collections.abc import Iterator
from pathlib import Path

from trainers.rangenet import mixture
from trainers.trial import Failed, Row, Trial

TITLE = "Open3D-ML, RandLANet"
SCRIPT = Path(__file__).parent / "scripts" / "train_open3d.py"


def rows(trial: Trial) -> Iterator[Row]:
    """Two epochs with validation."""
    python = trial.environment("open3d-cpu[ml]", "tensorboard")
    data = trial.folder / "SemanticKitti"
    data.mkdir()
    (data / "dataset").symlink_to(trial.data.semantic_kitti)
    trial.run(
        "train", [python, SCRIPT, data, mixture(trial)], minutes=90,
        expect=[r"epoch 1: \d+ samples, [1-9]\d* of them synthetic", r"Loss train: \d", r"eval: \d"],
    )  # fmt: skip
    if not list(trial.folder.rglob("ckpt_00001.pth")):
        raise Failed("no checkpoint")
    left_out = "open3d with CUDA: a GPU; stock 45,056 points: time; its pipeline cannot resume an epoch"
    yield trial.row("pipeline.run_train()", ["training", "validation", "checkpoint"], left_out)
