"""SalsaNext: its ``train.py`` with validation on 64 x 1024 images, and a resumed run."""

import re
from collections.abc import Iterator
from pathlib import Path

from trainers.rangenet import EPOCH, PAGE, WIDTH, clone, configure, mixture
from trainers.trial import STEPS, Failed, Row, Trial

TITLE = "SalsaNext"


def rows(trial: Trial) -> Iterator[Row]:
    """Two epochs in one run, and one epoch with one more in a resumed run."""
    python = trial.environment()
    root = clone(trial, "SALSANEXT_ROOT")
    tree = root / "train/tasks/semantic"
    (tree / "salsanext.yml").write_text((root / "salsanext.yml").read_text())
    expect = [r"Loss \d", "Validation set:", "Finished Training"]

    def train(title: str, epochs: int, resumed: Path | None = None) -> str:
        names = configure(trial, tree, "salsanext.yml", epochs=epochs, width=WIDTH) | {
            "LOG": trial.folder / "log"
        }
        names |= {"/data/mix.yaml": mixture(trial)} | (
            {'-p ""': f"-p {resumed}"} if resumed else {}
        )
        return trial.type_page(
            title, python, PAGE, names, skip="NAME", expect=expect, minutes=120
        )

    said = train("train", 1)
    (log,) = (trial.folder / "log" / "logs").iterdir()
    if not re.search(EPOCH, said) or not (log / "SalsaNext").is_file():
        raise Failed("no synthetic scans, or no checkpoint")
    resumed = train("resume", 2, log)
    if not re.search(
        r"lidar_synth: epoch 1: \d+ samples, [1-9]\d* of them synthetic", resumed
    ):
        raise Failed("the resumed run did not begin with epoch 1")
    if re.search(r"Epoch: \[0\]", resumed):
        raise Failed("the resumed run trained epoch 0 again")
    yield trial.row(
        "rangenet train.py -ac salsanext.yml", STEPS, "the uncertainty version: time"
    )
