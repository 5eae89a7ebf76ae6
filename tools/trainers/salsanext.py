"""SalsaNext: its ``train.py`` with validation on 64 x 1024 images, and a resumed run."""

import re
from collections.abc import Iterator

from trainers.rangenet import EPOCH, PACKAGES, WIDTH, clone, command, environment
from trainers.trial import STEPS, Failed, Row, Trial

TITLE = "SalsaNext"


def rows(trial: Trial) -> Iterator[Row]:
    """Two epochs in one run, and one epoch with one more in a resumed run."""
    python = trial.environment(*PACKAGES)
    tree = clone(trial, "SALSANEXT_ROOT")
    options = {"cwd": tree / "train/tasks/semantic", "env": environment(trial)}
    expect = [r"Loss \d", "Validation set:", "Finished Training"]

    def train(title: str, epochs: int, folder: object) -> str:
        arguments = command(trial, python, tree, "salsanext.yml", epochs=epochs, width=WIDTH)
        return trial.run(title, [*arguments, "-p", folder], **options, expect=expect, minutes=120)

    said = train("train", 1, "")
    (log,) = (trial.folder / "log" / "logs").iterdir()
    if not re.search(EPOCH, said) or not (log / "SalsaNext").is_file():
        raise Failed("no synthetic scans, or no checkpoint")
    resumed = train("resume", 2, log)
    if not re.search(r"lidar_synth: epoch 1: \d+ samples, [1-9]\d* of them synthetic", resumed):
        raise Failed("the resumed run did not begin with epoch 1")
    if re.search(r"Epoch: \[0\]", resumed):
        raise Failed("the resumed run trained epoch 0 again")
    yield trial.row("rangenet train.py -ac salsanext.yml", STEPS, "the uncertainty version: time")
