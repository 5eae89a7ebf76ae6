"""The recipes of the paper's models against what R2Flow, LiDM and the paper say, field by field.

Sources: R2Flow at commit 3f5afeb (r2flow/utils/option.py, train.py, r2flow/models/hdit.py), LiDM at
commit 8416ddb (models/lidm/kitti/*/config.yaml, models/first_stage_models/kitti/f_c2_p4*,
configs/autoencoder/kitti/autoencoder_c2_p4.yaml, lidm/models, lidm/data), the paper's
"Implementation Details".
"""

from typing import Any

import pytest
import torch

from lidar_synth.files.recipes import find_recipe, read_file
from lidar_synth.generate.conditions import CONDITIONS
from lidar_synth.generate.models import build_network
from lidar_synth.geometry.sensor import load_sensor
from lidar_synth.lab.train.config import (
    DistillConfig,
    Run,
    TrainConfig,
    load_config,
    published,
)
from lidar_synth.lab.train.state import Recipe, kept_share

BESIDE = {
    "output",
    "licence",
    "seed",
    "compile",
    "gradient_checkpointing",
    "save_every",
    "samples",
    "data.licence",
    "data.on_bad",
    "data.cache",
    "data.jobs",
    "data.seed",
    "data.interval",
    "data.motion",
}
"""Fields that change nothing of the weights, or are none of a published configuration."""

NONE = {
    "held_out": None,
    "rehearsal": None,
    "data.town": None,
    "data.latents": False,
    "data.seen": None,
    "data.sensor": None,
    "data.fields": None,
    "data.topic": None,
    "data.reflectance_max": None,
    "recipe.weights": {},
    "recipe.optimizer": "adamw",
}
TEACHER = NONE | {"decoder": False, "init": None}
STUDENT = NONE | {
    "init": None,
    "guidance": 1.0,
    "weaker": None,
    "within": (0.0, 1.0),
    "also": (),
    "selection": {"candidates": 100, "trajectories": 256, "batch": 1, "seed": 0},
    "strategy": "adaptive_piecewise",
    "intervals": 4,
}
"""The paper: 256 samples and 100 steps for the selection, 4 intervals, the teacher without
guidance."""

R2FLOW = {
    "precision": "no",  # mixed_precision
    "recipe.batch": 8,
    "recipe.accumulate": 1,
    "recipe.rate": 1e-4,
    "recipe.betas": (0.9, 0.99),
    "recipe.weight_decay": 0.0,
    "recipe.schedule": "cosine",
    "recipe.warmup": 80_000 // 8,  # num_images_lr_warmup
    "recipe.clip": 1.0,
    "recipe.ema_decay": 0.995,
    "recipe.ema_every": 10,
    "recipe.ema_after": 80_000 // 8,
    "data.flip": False,
    "data.roll": False,
}
LIDM = {
    "precision": "no",
    "recipe.accumulate": 1,
    "recipe.betas": (0.9, 0.999),  # torch's
    "recipe.weight_decay": 0.01,  # torch's
    "recipe.schedule": "constant",
    "recipe.warmup": 0,
    "recipe.clip": 1e9,  # none
    "recipe.ema_decay": 0.9999,
    "recipe.ema_every": 1,
    "recipe.ema_after": 0,
    "data.roll": False,
}
BOTH_WAYS = {"data.flip": "both"}
PIXEL = {
    "data.layout": "kitti360",
    "data.path": "$KITTI360_ROOT",
    "data.split": "r2flow/train",
    "data.more": (),
}
KITTI360 = PIXEL | {"data.split": "lidm/train"}
CAMERA = PIXEL | {"data.split": "lidm-camera/train", "data.flip": False}
LABELS = {
    "data.layout": "semantic_kitti",
    "data.path": "$SEMANTICKITTI_ROOT",
    "data.split": "train",
    "data.more": (),
}
UNET = {
    "network": {
        "architecture": "unet",
        "arguments": {
            "width": 256,
            "multipliers": [1, 2, 4],
            "blocks": 2,
            "attention": [0, 1, 2],  # attention_resolutions 1, 2, 4
            "head_channels": 32,
            "position": True,  # the paper's
        },
    },
    "timesteps": "uniform",
    "steps": 50,  # of tables 2 to 5
    "condition": None,
}
OF_THE_CODEC = {"sensor", "channels", "normalisation", "rays", "losses"}
"""What a latent model takes from its autoencoder, or does not have."""
CODEC = {
    "precision": "no",
    "sensor": "hdl64e_kitti360",
    "channels": ("range",),
    "normalisation": "lidm_linear",
    "network": {
        "architecture": "vqvae",
        "arguments": {
            "latent_channels": 8,  # embed_dim, z_channels
            "codes": 16384,
            "width": 64,
            "multipliers": [1, 2, 2, 4],
            "strides": [[1, 2], [2, 2], [2, 2]],
            "blocks": 2,
        },
    },
    "losses": {
        "commitment": 1.0,
        "codebook": 0.25,  # the quantiser's beta, on the codes
        "geometric": 0.0,  # geo_factor
        "mask": 1.0,  # without a mask
        "adversarial": 0.6,  # disc_weight
        "adaptive": True,
        "discriminator_width": 64,  # disc_ndf
    },
    "codec": None,
    "condition": None,
    "recipe.metric": "l1",
    "recipe.batch": 4 * 2,
    "recipe.accumulate": 2,
    "recipe.rate": pytest.approx(4.5e-6 * 4 * 2),
    "recipe.betas": (0.5, 0.9),
    "recipe.weight_decay": 0.0,  # Adam
    "recipe.schedule": "constant",
    "recipe.warmup": 0,
    "recipe.clip": 1e9,
    "recipe.ema_decay": 0.0,  # use_ema false
    "recipe.ema_every": 1,
    "recipe.ema_after": 0,
    "data.flip": "both",
    "data.roll": 45.0,
    "recipe.iterations": 200_000,
}
ODOMETRY = [("semantic_kitti", "train"), ("semantic_kitti", "test")]
TABLE: dict[str, dict[str, Any]] = {
    "kitti360_teacher": TEACHER
    | R2FLOW
    | PIXEL
    | {
        "sensor": "hdl64e_kitti360",
        "channels": ("range", "reflectance"),
        "normalisation": "r2flow",
        "rays": "corner",
        "network": {
            "architecture": "hdit",
            "arguments": {
                "width": 128,
                "time_width": 256,
                "depths": [3, 3, 3, 3],
                "heads": [2, 4, 8, 16],
                "patch": [1, 4],
                "window": [3, 9],
                "ratio": 3.0,
                "position": "learned",
            },
        },
        "codec": None,
        "condition": None,
        "timesteps": "uniform",
        "steps": 50,
        "recipe.iterations": 2_560_000 // 8,  # num_images_training
        "recipe.metric": "squared_l2",
    },
    "kitti360_student": STUDENT
    | R2FLOW
    | PIXEL
    | {
        "teacher": "kitti360_teacher",
        "grid": (1.0, 0.86, 0.58, 0.22, 0.0),
        "steps": 20,
        "recipe.metric": "pseudo_huber",
        "recipe.iterations": 100_000,
    },
    "kitti360_codec": TEACHER | KITTI360 | CODEC | {"data.more": ODOMETRY},
    "semantic_kitti_codec": TEACHER
    | LABELS
    | CODEC
    | {
        "sensor": "hdl64e_semantic_kitti",
        "data.more": [("semantic_kitti", "test"), ("kitti360", "lidm/train")],
    },
}
OF_TASKS = {
    "kitti360_latent": (
        KITTI360 | BOTH_WAYS,
        (1.0, 0.82, 0.57, 0.28, 0.0),
        {"recipe.batch": 4, "recipe.rate": pytest.approx(1e-6 * 4)},
    ),
    "kitti360_camera": (
        CAMERA,
        (1.0, 0.74, 0.48, 0.22, 0.0),
        {"recipe.batch": 8, "recipe.rate": pytest.approx(2e-6 * 8)},
    ),
    "semantic_kitti": (
        LABELS | BOTH_WAYS,
        (1.0, 0.42, 0.20, 0.08, 0.0),
        {"recipe.batch": 16, "recipe.rate": pytest.approx(1e-6 * 16)},
    ),
}
for task, (data, grid, optimisation) in OF_TASKS.items():
    shared = LIDM | data | optimisation | {"recipe.metric": "squared_l2"}
    TABLE[f"{task}_teacher"] = (
        TEACHER
        | shared
        | UNET
        | {
            "codec": f"{task.partition('_')[0]}_codec"
            if task.startswith("kitti360")
            else f"{task}_codec",
            "recipe.iterations": 400_000,
        }
    )
    TABLE[f"{task}_student"] = (
        STUDENT
        | shared
        | {
            "teacher": f"{task}_teacher",
            "grid": grid,
            "steps": 10,
            "recipe.iterations": 100_000,
        }
    )
TABLE["kitti360_camera_teacher"]["condition"] = {
    "kind": "camera",
    "encoder": "clip_views",
    "arguments": {"views": 4, "channels": 512},  # split_per_view, out_dim
    "view_dropout": 0.5,  # camera_drop
    "image": (376, 1408),
    "focal": 552.55,
    "views": 4,
}
TABLE["semantic_kitti_teacher"]["condition"] = {
    "kind": "semantic",
    "arguments": {"channels": 8, "method": "rescale"},  # SpatialRescaler
    "keep_gaps": True,
}
OPTIMISATION = {name for name in R2FLOW if name != "recipe.accumulate"}
UNSTATED = {
    "kitti360_teacher": set(),
    "kitti360_codec": {"recipe.iterations"},
    "semantic_kitti_codec": {"recipe.iterations"},
}
"""What neither the paper nor the project that it follows there states, by recipe; of all others,
how they are optimised."""


def flat(config: Run) -> dict[str, Any]:
    """The fields of a configuration, those of its data and of its optimisation one by one."""
    values: dict[str, Any] = {}
    for name in type(config).model_fields:
        value = getattr(config, name)
        if name == "data":
            fields = {key: getattr(value, key) for key in type(value).model_fields}
        elif name == "recipe":
            fields = vars(value)
        else:
            values[name] = value
            continue
        values |= {f"{name}.{key}": field for key, field in fields.items()}
    return values


def plain(name: str, value: Any) -> Any:
    """A field as the table writes it."""
    if name in ("codec", "teacher"):
        return None if value is None else value.stem
    if name == "data.more":
        return [(one.layout, one.split) for one in value] or ()
    if name == "losses":
        return {key: getattr(value, key) for key in CODEC["losses"]}
    if name == "condition" and value is not None:
        set_ = value.model_dump(exclude_unset=True)
        return {key: field for key, field in set_.items() if field}
    return value.model_dump() if name in ("network", "selection") else value


PAPERS = [
    one.name for one in published() if one.name.startswith(("kitti360_", "semantic_"))
]


def test_the_table_has_all_recipes_of_the_paper() -> None:
    assert set(TABLE) == set(PAPERS)


@pytest.mark.parametrize("name", PAPERS)
def test_a_recipe_is_as_published_in_every_field(name: str) -> None:
    kind: type[Run] = DistillConfig if name.endswith("_student") else TrainConfig
    values = flat(load_config(kind, name))
    expected = TABLE[name]
    compared = {
        key: plain(key, value) for key, value in values.items() if key not in BESIDE
    }
    if "_teacher" in name and name != "kitti360_teacher":
        compared = {k: v for k, v in compared.items() if k not in OF_THE_CODEC}
    elif name.endswith("_codec"):
        assert compared.pop("steps") == 50  # of a flow
        assert compared.pop("timesteps") == "uniform"
        assert compared.pop("rays") == "centre"  # seen by no convolution
    else:
        compared.pop("losses", None)
    wrong = {
        key: (compared.get(key), expected.get(key))
        for key in compared | expected
        if key not in compared or key not in expected or compared[key] != expected[key]
    }
    assert wrong == {}


@pytest.mark.parametrize("name", PAPERS)
def test_a_recipe_marks_what_nobody_states(name: str) -> None:
    about = read_file(find_recipe(name))["about"]
    unstated = UNSTATED.get(name, OPTIMISATION | {"recipe.iterations"})
    if name.endswith("_teacher") and name not in UNSTATED:
        unstated = unstated | {"timesteps"}
    assert set(about["not_stated"]) == unstated
    assert unstated <= set(TABLE[name])


def test_the_scales_and_the_grid_are_those_of_both_projects() -> None:
    pixel = load_config(TrainConfig, "kitti360_teacher").tensors().normalisation
    assert (pixel.kind, pixel.range_min, pixel.range_max) == ("log", 1.45, 80.0)
    latent = load_config(TrainConfig, "kitti360_codec").tensors().normalisation
    assert (latent.kind, latent.range_min, latent.range_max) == ("linear", 1.0, 56.0)
    for preset in ("hdl64e_kitti360", "hdl64e_semantic_kitti"):
        sensor = load_sensor(preset)
        assert (sensor.shape, sensor.up, sensor.down) == ((64, 1024), 3.0, -25.0)


def test_r2flows_network_needs_no_tf32() -> None:
    """R2Flow forbids TF32: torch has it off for products of matrices, and there are no
    convolutions."""
    assert torch.get_float32_matmul_precision() == "highest"
    config = load_config(TrainConfig, "kitti360_teacher")
    with torch.device("meta"):
        network = build_network(
            *config.parts((2, 64, 1024), (64, 1024))["velocity"],
        )
    assert not [m for m in network.modules() if "Conv" in type(m).__name__]


def test_the_averages_grow_as_those_of_r2flow_and_lidm() -> None:
    r2flow = load_config(TrainConfig, "kitti360_teacher").recipe
    assert [kept_share(r2flow, step) for step in (10, 9_990, 10_000)] == [0, 0, 0]
    # ema_pytorch: 1 - (1 + updates' steps) ** (-2 / 3), up to the decay
    assert kept_share(r2flow, 10_010) == pytest.approx(1 - 10 ** (-2 / 3))
    assert kept_share(r2flow, 20_000) == 0.995
    lidm = load_config(TrainConfig, "kitti360_latent_teacher").recipe
    assert kept_share(lidm, 1) == pytest.approx(2 / 11)
    assert kept_share(lidm, 10**6) == 0.9999
    codec = load_config(TrainConfig, "kitti360_codec").recipe
    assert kept_share(codec, 100) == 0  # the network's own weights
    assert kept_share(Recipe(1), 1_000) == pytest.approx(101 / 110)


def test_only_conditions_that_turn_are_turned() -> None:
    for name in PAPERS:
        condition = TABLE[name].get("condition")
        if condition and not CONDITIONS[condition["kind"]].turns:
            assert not TABLE[name]["data.flip"] and not TABLE[name]["data.roll"]
