"""Cylinder3D: its ``train_cylinder_asym.py`` with validation, by spconv 2."""

from collections.abc import Iterator

import yaml

from trainers.rangenet import mixture
from trainers.trial import Failed, Row, Trial

TITLE = "Cylinder3D"


def rows(trial: Trial) -> Iterator[Row]:
    """Two epochs: its script validates from the second on."""
    python = trial.environment()
    tree = trial.tree("CYLINDER3D_ROOT")
    own = yaml.safe_load((tree / "config/semantickitti.yaml").read_text())
    own["dataset_params"]["pc_dataset_type"] = "SemKITTI_mixed"
    for loader in ("train_data_loader", "val_data_loader"):
        own[loader] |= {
            "data_path": f"{trial.data.semantic_kitti}/sequences",
            "num_workers": 1,
            "batch_size": 1,
        }
    own["model_params"] |= {
        "output_shape": [120, 90, 16],
        "init_size": 8,
        "out_fea_dim": 64,
    }
    model = trial.folder / "model.pt"
    own["train_params"] |= {"max_num_epochs": 2, "eval_every_n_steps": 8}
    own["train_params"] |= {
        "model_load_path": str(model),
        "model_save_path": str(model),
    }
    config = trial.folder / "mixed.yaml"
    config.write_text(yaml.safe_dump(own))
    names = {
        "Cylinder3D": tree,
        "/data/mix.yaml": mixture(trial),
        "config/mixed.yaml": config,
    }
    trial.type_page(
        "train",
        python,
        "cylinder3d",
        names,
        minutes=120,
        expect=[
            r"epoch 1: \d+ samples, [1-9]\d* of them synthetic",
            r"loss: \d",
            r"Current val loss is \d",
        ],
    )
    if not model.is_file():
        raise Failed("no checkpoint")
    yield trial.row(
        "cylinder3d train_cylinder_asym.py",
        ["training", "validation", "checkpoint"],
        "the stock grid of 480 x 360 x 32 and width: memory and time; it cannot resume an epoch",
    )
