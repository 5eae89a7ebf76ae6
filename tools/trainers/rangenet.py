"""RangeNet++ (lidar-bonnetal): its ``train.py`` with validation, SqueezeSeg on 64 x 2048 images,
the stock width."""

import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from trainers.trial import Failed, Row, Trial

TITLE = "RangeNet++, SqueezeSeg"
PAGE = "range-view"
ARCH = "config/arch/squeezeseg.yaml"
WIDTH = 1024
STOCK_WIDTH = 2048
"""Columns of the model ``town``, whose scans the launcher refuses at the stock width, and this
width."""
EPOCH = r"lidar_synth: epoch 0: \d+ samples, [1-9]\d* of them synthetic"


def rows(trial: Trial) -> Iterator[Row]:
    """Train for an epoch on dense scans, after scans of 1,024 columns have been refused."""
    python = trial.environment()
    tree = clone(trial, "RANGENET_ROOT") / "train/tasks/semantic"
    names = configure(trial, tree, ARCH, epochs=1, width=STOCK_WIDTH) | {
        "LOG": trial.folder / "log"
    }
    names["/data/mix.yaml"] = mixture(trial)
    expect = ["empty cell to the right", f"width: {WIDTH}"]
    trial.type_page(
        "1024 columns", python, PAGE, names, skip=" -p ", fails=True, expect=expect
    )
    names["/data/mix.yaml"] = mixture(trial, trial.data.dense_bank)
    expect = [EPOCH, r"Loss \d", "Validation set:", "IoU avg"]
    said = trial.type_page(
        "train", python, PAGE, names, skip=" -p |^pip", expect=expect, minutes=60
    )
    if "Loss nan" in said or not list(
        (trial.folder / "log").glob("segmentation_head*")
    ):
        raise Failed("a loss of NaN, or no checkpoint")
    left_out = "Darknet-53: time; it cannot resume an epoch"
    yield trial.row(
        "rangenet train.py -ac squeezeseg.yaml",
        ["training", "validation", "checkpoint"],
        left_out,
    )


def mixture(trial: Trial, bank: Path | None = None) -> Path:
    """The file of a mixture with a bank, by default that of ``town``."""
    out = trial.folder / "mix.yaml"
    out.write_text(
        yaml.safe_dump(
            {"synthetic": str(bank or trial.data.bank), "ratio": 0.4, "seed": 3}
        )
    )
    return out


def clone(trial: Trial, variable: str) -> Path:
    """The tree with a commit, which lidar-bonnetal's script asks git for, as ``git clone`` leaves
    it."""
    tree = trial.tree(variable)
    who = ["-c", "user.name=trial", "-c", "user.email=trial@localhost"]
    for arguments in (
        ["init", "-q"],
        [*who, "commit", "-q", "--allow-empty", "-m", "copy"],
    ):
        subprocess.run(["git", *arguments], cwd=tree, check=True)
    return tree


def configure(
    trial: Trial, tree: Path, arch: str, *, epochs: int, width: int
) -> dict[str, Any]:
    """What the reader has in place of the page's names: the stock configuration with another width
    and batch size.

    The clone's own list of sequences, which the page names, is made shorter.
    """
    own = yaml.safe_load((tree / arch).read_text())
    own["train"] |= {
        "max_epochs": epochs,
        "batch_size": 1 if trial.data.scans < 2 else 2,
        "workers": 1,
    }
    own["train"]["report_batch"] = 1
    own["dataset"]["sensor"]["img_prop"]["width"] = width
    (trial.folder / "arch.yaml").write_text(yaml.safe_dump(own))
    labels = tree / "config/labels/semantic-kitti.yaml"
    split = {"split": {"train": [0, 1, 3], "valid": [8], "test": []}}
    labels.write_text(yaml.safe_dump(yaml.safe_load(labels.read_text()) | split))
    return {
        "TREE": tree,
        "SEMANTICKITTI": trial.data.semantic_kitti,
        "ARCH.yaml": trial.folder / "arch.yaml",
    }
