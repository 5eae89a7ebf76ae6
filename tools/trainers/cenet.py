"""CENet: its ``train.py`` with validation on 64 x 512 images, with the network of FIDNet."""

from collections.abc import Iterator

from trainers.rangenet import EPOCH, PAGE, clone, configure, mixture
from trainers.trial import Failed, Row, Trial

TITLE = "CENet, FIDNet"
ARCH = "config/arch/senet-512.yml"


def rows(trial: Trial) -> Iterator[Row]:
    """One epoch with validation."""
    python = trial.environment()
    tree = clone(trial, "CENET_ROOT")
    stock = (tree / ARCH).read_text()
    fidnet = stock.replace('pipeline: "res"', 'pipeline: "fid"').replace("aux_loss: True", "aux_loss: False")
    (tree / ARCH).write_text(fidnet)
    names = configure(trial, tree, ARCH, epochs=1, width=512) | {"LOG": trial.folder / "log", "NAME": "mixed"}
    names["/data/mix.yaml"] = mixture(trial)
    expect = [EPOCH, r"Loss \d", "Validation set:", "IoU avg"]
    said = trial.type_page("train", python, PAGE, names, skip=" -p ", expect=expect, minutes=60)
    if "Loss nan" in said or not list((trial.folder / "log").rglob("SENet*")):
        raise Failed("a loss of NaN, or no checkpoint")
    left_out = "mixed precision; it cannot resume an epoch"
    yield trial.row("rangenet train.py -ac senet-512.yml", ["training", "validation", "checkpoint"], left_out)
