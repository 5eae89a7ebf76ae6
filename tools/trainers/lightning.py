"""Lightning from the package index: fit with validation, and runs resumed at an epoch's start and
in its middle."""

from collections.abc import Iterator
from pathlib import Path

from trainers.trial import STEPS, Failed, Row, Trial

TITLE = "Lightning"

SCRIPTS = Path(__file__).parent / "scripts"
"""``segmenter.py`` there is the reader's own model."""
OPTIONS = (
    "accelerator='cpu', logger=False, enable_progress_bar=False, "
    "callbacks=[lightning.pytorch.callbacks.ModelCheckpoint({folder!r}, 'last', "
    "every_n_train_steps=1)]"
)


def rows(trial: Trial) -> Iterator[Row]:
    """A small segmenter on SemanticKITTI and a bank."""
    python = trial.environment(extras=("lightning",))

    def fit(
        title: str, out: str, limit: str = "max_epochs=2", resumed: bool = False
    ) -> list[str]:
        folder = trial.folder / out
        checkpoint = str(folder / "last.ckpt") if resumed else None
        names = {
            "demo_out/town": trial.data.semantic_kitti,
            "demo_out/bank": trial.data.bank,
            "import lightning": "import lightning\nfrom segmenter import Segmenter",
            "max_epochs=1": f"{limit}, {OPTIONS.format(folder=str(folder))}",
            "# then trainer.fit(model, data)": "\ntrainer.fit(Segmenter(), data, "
            f"ckpt_path={checkpoint!r})",
        }
        env = {"PYTHONPATH": str(SCRIPTS)}
        expect = [r"validation loss \d"] if out == "whole" else []
        said = trial.type_page(
            title, python, "lightning", names, env=env, expect=expect
        )
        return [line for line in said.splitlines() if line.startswith("sample ")]

    seen = fit("train", "whole")
    if not {"domain 0", "domain 1"} <= {" ".join(line.split()[3:5]) for line in seen}:
        raise Failed("no real or no synthetic sample in the uninterrupted run")
    for name, limit in {
        "middle": "max_epochs=2, max_steps=3",
        "end": "max_epochs=1",
    }.items():
        first = fit(f"stop in the {name} of an epoch", name, limit)
        rest = fit(f"resume from the {name} of an epoch", name, resumed=True)
        if not rest or first + rest != seen:
            raise Failed(
                f"resuming from the {name} of an epoch gives other samples; see "
                f"{trial.folder / 'logs'}"
            )
    yield trial.row("trainer.fit(model, data)", STEPS, "GPUs: `on_device`")
