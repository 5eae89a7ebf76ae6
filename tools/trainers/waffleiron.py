"""WaffleIron: its ``launch_train.py`` with validation, and a resumed run."""

import re
from collections.abc import Iterator

import yaml

from trainers.rangenet import mixture
from trainers.trial import STEPS, Failed, Row, Trial

TITLE = "WaffleIron"
NAME = "semantic_kitti_mixed"


def rows(trial: Trial) -> Iterator[Row]:
    """Two epochs in one run; one epoch, and a second one in a resumed run."""
    python = trial.environment()
    tree = trial.tree("WAFFLEIRON_ROOT")
    dataset = trial.folder / "KITTI"
    dataset.mkdir()
    (dataset / "dataset").symlink_to(trial.data.semantic_kitti)
    own = yaml.safe_load((tree / "configs/WaffleIron-48-256__kitti.yaml").read_text())
    own["augmentations"]["instance_cutmix"] = False
    own["dataloader"] |= {"batch_size": 2, "num_workers": 1, "max_points": 5000}
    own["waffleiron"] |= {"depth": 6, "nb_channels": 64}

    def train(log: str, epochs: int, more: str = "") -> str:
        config = trial.folder / f"{log}-{epochs}.yaml"
        own["scheduler"] |= {"max_epoch": epochs, "epoch_warmup": 0.5}
        config.write_text(yaml.safe_dump(own))
        names = {"WaffleIron": tree, "/data/mix.yaml": mixture(trial), "KITTI": dataset}
        names |= {
            "configs/WaffleIron-48-256__kitti.yaml": config,
            "LOG": f"{trial.folder / log} {more}",
        }
        said = trial.type_page(
            f"{log} {epochs}",
            python,
            "waffleiron",
            names,
            minutes=60,
            expect=[r"Loss = \d", "Validation: ", "Finished Training"],
        )
        found = re.findall(r"lidar_synth: epoch 1: .*", said)
        return found[0] if found else ""

    whole = train("whole", 2)
    train("stopped", 1)
    if not whole or train("stopped", 2, "--restart") != whole:
        raise Failed("the resumed run has another mixture in epoch 1")
    if not (trial.folder / "stopped" / "ckpt_last.pth").is_file():
        raise Failed("no checkpoint")
    left_out = (
        "--fp16 and --multiprocessing-distributed: GPUs; CutMix: all of SemanticKITTI; stock "
        "depth: time"
    )
    yield trial.row(f"waffleiron launch_train.py --dataset {NAME}", STEPS, left_out)
