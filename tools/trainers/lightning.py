"""Lightning from the package index: fit with validation, and runs resumed at an epoch's start and in its middle."""

from collections.abc import Iterator
from pathlib import Path

from trainers.trial import STEPS, Failed, Row, Trial

TITLE = "Lightning"

SCRIPT = Path(__file__).parent / "scripts" / "fit_lightning.py"
EPOCHS = ["--max-epochs", "2"]


def rows(trial: Trial) -> Iterator[Row]:
    """A small segmenter on SemanticKITTI and a bank."""
    python = trial.environment(extras=("lightning",))
    command = [python, SCRIPT, "--scans", trial.data.semantic_kitti, "--bank", trial.data.bank]
    whole = trial.run("train", [*command, "--out", trial.folder / "whole", *EPOCHS], expect=[r"validation loss \d"])
    seen = samples(whole)
    if not {"domain 0", "domain 1"} <= {" ".join(line.split()[3:5]) for line in seen}:
        raise Failed("no real or no synthetic sample in the uninterrupted run")
    for name, limit in {"middle of an epoch": ["--max-steps", "3"], "end of an epoch": ["--max-epochs", "1"]}.items():
        out = trial.folder / name.replace(" ", "-")
        first = trial.run(f"stop in the {name}", [*command, "--out", out, *limit])
        rest = trial.run(f"resume from the {name}", [*command, "--out", out, *EPOCHS, "--resume", out / "last.ckpt"])
        if not samples(rest) or samples(first) + samples(rest) != seen:
            raise Failed(f"resuming from the {name} gives other samples; see {trial.folder / 'logs'}")
    yield trial.row(f"python {SCRIPT.name} --scans SemanticKITTI --bank bank", STEPS, "GPUs: `on_device`")


def samples(output: str) -> list[str]:
    """The lines of a log that name a training sample."""
    return [line for line in output.splitlines() if line.startswith("sample ")]
