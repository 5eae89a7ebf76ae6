"""CENet: its ``train.py`` with validation on 64 x 512 images, with its stock network and with that
of FIDNet."""

from collections.abc import Iterator
from pathlib import Path

from trainers.rangenet import EPOCH, PAGE, clone, configure, mixture
from trainers.trial import Failed, Row, Trial

TITLE = "CENet"
ARCH = "config/arch/senet-512.yml"
FIDNET = {
    'pipeline: "res"': 'pipeline: "fid"',
    "aux_loss: True": "aux_loss: False",
    "Hardswish": "LeakyReLU",
}


def rows(trial: Trial) -> Iterator[Row]:
    """One epoch with validation of each network."""
    python = trial.environment()
    tree = clone(trial, "CENET_ROOT")
    yield one(trial, python, tree, "res")
    stock = (tree / ARCH).read_text()
    for name, other in FIDNET.items():
        stock = stock.replace(name, other, 1)
    (tree / ARCH).write_text(stock)
    yield one(trial, python, tree, "fid")


def one(trial: Trial, python: Path, tree: Path, network: str) -> Row:
    """Train and validate for an epoch."""
    log = trial.folder / f"log-{network}"
    names = configure(trial, tree, ARCH, epochs=1, width=512) | {
        "LOG": log,
        "NAME": "mixed",
    }
    names["/data/mix.yaml"] = mixture(trial)
    expect = [EPOCH, r"Loss \d", "Validation set:", "IoU avg"]
    skip = r" -p |^pip" if network == "fid" else " -p "
    said = trial.type_page(
        f"train {network}", python, PAGE, names, skip=skip, expect=expect, minutes=60
    )
    if "Loss nan" in said or not list(log.rglob("SENet*")):
        raise Failed("a loss of NaN, or no checkpoint")
    left_out = "mixed precision; it cannot resume an epoch"
    ran = ["training", "validation", "checkpoint"]
    return trial.row(
        f"rangenet train.py -ac senet-512.yml, pipeline {network}", ran, left_out
    )
