"""RangeNet++ (lidar-bonnetal): its ``train.py`` with validation, SqueezeSeg on 64 x 2048 images, the stock width."""

import subprocess
from collections.abc import Iterator
from pathlib import Path

import yaml

from trainers.trial import Failed, Row, Trial

TITLE = "RangeNet++, SqueezeSeg"
VARIABLE = "RANGENET_ROOT"
ARCH = "train/tasks/semantic/config/arch/squeezeseg.yaml"
WIDTH, STOCK_WIDTH = 1024, 2048
"""Columns of the model ``town``, whose scans the launcher refuses at the stock width, and this width."""
PACKAGES = ("tensorboard", "opencv-python-headless", "scipy")
EPOCH = r"lidar_synth: epoch 0: \d+ samples, [1-9]\d* of them synthetic"


def rows(trial: Trial) -> Iterator[Row]:
    """Train for an epoch on dense scans, after scans of 1,024 columns have been refused."""
    python = trial.environment(*PACKAGES)
    tree = clone(trial, VARIABLE)
    train, folder = command(trial, python, tree, ARCH, epochs=1, width=STOCK_WIDTH), tree / "train/tasks/semantic"
    trial.run(
        "1024 columns", train, cwd=folder, env=environment(trial), fails=True,
        expect=["empty cell to the right", f"width: {WIDTH}"],
    )  # fmt: skip
    said = trial.run(
        "train", train, cwd=folder, env=environment(trial, trial.data.dense_bank),
        expect=[EPOCH, r"Loss \d", "Validation set:", "IoU avg"], minutes=60,
    )  # fmt: skip
    if "Loss nan" in said or not list((trial.folder / "log").glob("segmentation_head*")):
        raise Failed("a loss of NaN, or no checkpoint")
    left_out = "Darknet-53: time; it cannot resume an epoch"
    yield trial.row("rangenet train.py -ac squeezeseg.yaml", ["training", "validation", "checkpoint"], left_out)


def environment(trial: Trial, bank: Path | None = None) -> dict[str, str]:
    """Variables for the launcher: the mixture with a bank, by default that of ``town``, and the CPU."""
    mixture = trial.folder / "mix.yaml"
    mixture.write_text(yaml.safe_dump({"synthetic": str(bank or trial.data.bank), "ratio": 0.4, "seed": 3}))
    return {"LIDAR_SYNTH_MIX": str(mixture), "LIDAR_SYNTH_CPU": "1"}


def clone(trial: Trial, variable: str) -> Path:
    """The tree with a commit, which lidar-bonnetal's script asks git for, as ``git clone`` leaves it."""
    tree = trial.tree(variable)
    who = ["-c", "user.name=trial", "-c", "user.email=trial@localhost"]
    for arguments in (["init", "-q"], [*who, "commit", "-q", "--allow-empty", "-m", "copy"]):
        subprocess.run(["git", *arguments], cwd=tree, check=True)
    return tree


def command(trial: Trial, python: Path, tree: Path, arch: str, *, epochs: int, width: int) -> list[object]:
    """The trainer's command: the stock configuration with another width, fewer sequences, batch size 2."""
    own = yaml.safe_load((tree / arch).read_text())
    own["train"] |= {"max_epochs": epochs, "batch_size": 2, "workers": 1, "report_batch": 1}
    own["dataset"]["sensor"]["img_prop"]["width"] = width
    labels = yaml.safe_load((tree / "train/tasks/semantic/config/labels/semantic-kitti.yaml").read_text())
    labels["split"] = {"train": [0, 1, 3], "valid": [8], "test": []}
    if trial.data.scans < 2:  # the trainer drops an incomplete batch, and needs one of validation
        own["train"]["batch_size"] = 1
    for name, content in {"arch": own, "labels": labels}.items():
        (trial.folder / f"{name}.yaml").write_text(yaml.safe_dump(content))
    files = ["-ac", trial.folder / "arch.yaml", "-dc", trial.folder / "labels.yaml", "-l", trial.folder / "log"]
    start = [python, "-m", "lidar_synth.integrations.rangenet", "train.py"]
    return [*start, "-d", trial.data.semantic_kitti, *files]
