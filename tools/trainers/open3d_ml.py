"""Open3D-ML: the lines of its page, with the ML part that is bundled with Open3D and its pipeline,
RandLANet."""

from collections.abc import Iterator
from pathlib import Path

import yaml

from trainers.rangenet import mixture
from trainers.trial import NOT_PIP, PIP, Failed, Row, Trial

TITLE = "Open3D-ML, RandLANet"
PAGE = "open3d-ml"
STOCK = "lib/python3*/site-packages/open3d/_ml3d/configs/randlanet_semantickitti.yml"


def rows(trial: Trial) -> Iterator[Row]:
    """Two epochs with validation."""
    python = trial.environment()
    trial.type_page("install", python, PAGE, {}, skip=NOT_PIP)
    data = trial.folder / "SemanticKitti"
    data.mkdir()
    (data / "dataset").symlink_to(trial.data.semantic_kitti)
    names = {"/data/SemanticKitti": data, "/data/mix.yaml": mixture(trial)}
    names["randlanet_semantickitti.yml"] = shorten(
        trial, next(python.parent.parent.glob(STOCK))
    )
    expect = [
        r"epoch 1: \d+ samples, [1-9]\d* of them synthetic",
        r"Loss train: \d",
        r"eval: \d",
    ]
    trial.type_page("train", python, PAGE, names, skip=PIP, expect=expect, minutes=90)
    if not list(trial.folder.rglob("ckpt_00001.pth")):
        raise Failed("no checkpoint")
    yield trial.row(
        "pipeline.run_train()",
        ["training", "validation", "checkpoint"],
        "open3d with CUDA: a GPU; stock 45,056 points: time; its pipeline cannot resume an epoch",
    )


def shorten(trial: Trial, stock: Path) -> Path:
    """The stock configuration with few points, for a CPU."""
    own = yaml.safe_load(stock.read_text())
    own["model"]["num_points"] = 4096
    own["pipeline"] |= {"batch_size": 2, "val_batch_size": 1, "max_epoch": 1}
    own["pipeline"] |= {"save_ckpt_freq": 1, "device": "cpu"}
    out = trial.folder / "randlanet.yml"
    out.write_text(yaml.safe_dump(own))
    return out
