# ruff: noqa: C408
# Sonata's stock pretraining, on SemanticKITTI's scans and synthetic ones, without labels:
#   cd Pointcept
# python tools/train.py --config-file .../pretrain_sonata_semantickitti.py --options
# save_path=exp/sonata The network, its losses and its schedule are those of the stock
# configuration. The data differ: a scan has a reflectance where a room has colours and normals, and
# its metres are divided by five, as Utonia's configuration does, so that the sizes of voxels, masks
# and matches fit.
from pathlib import Path as __Path

_base_ = [str(__Path("configs/sonata/pretrain-sonata-v1m1-0-base.py").resolve())]

custom_imports = dict(
    imports=["lidar_synth.integrations.pointcept"], allow_failed_imports=False
)

model = dict(backbone=dict(in_channels=4))

view = [
    dict(type="CenterShift", apply_z=True),
    dict(type="RandomScale", scale=[0.9, 1.1]),
    dict(type="RandomRotate", angle=[-1, 1], axis="z", center=[0, 0, 0], p=0.8),
    dict(type="RandomRotate", angle=[-1 / 64, 1 / 64], axis="x", p=0.8),
    dict(type="RandomRotate", angle=[-1 / 64, 1 / 64], axis="y", p=0.8),
    dict(type="RandomFlip", p=0.5),
    dict(type="RandomJitter", sigma=0.005, clip=0.02),
]
parts = ("origin_coord", "coord", "strength", "offset")
transform = [
    dict(type="RandomScale", scale=[0.18, 0.22]),
    dict(type="GridSample", grid_size=0.02, hash_type="fnv", mode="train"),
    dict(type="Copy", keys_dict={"coord": "origin_coord"}),
    dict(
        type="MultiViewGenerator",
        view_keys=parts[:3],
        global_view_num=2,
        global_view_scale=(0.4, 1.0),
        local_view_num=4,
        local_view_scale=(0.1, 0.4),
        global_transform=view,
        local_transform=view,
        max_size=65536,
    ),
    dict(type="ToTensor"),
    dict(type="Update", keys_dict={"grid_size": 0.02}),
    dict(
        type="Collect",
        keys=(
            *[f"{size}_{part}" for size in ("global", "local") for part in parts],
            "grid_size",
            "name",
        ),
        offset_keys_dict={},
        global_feat_keys=("global_coord", "global_strength"),
        local_feat_keys=("local_coord", "local_strength"),
    ),
]
data = dict(
    train=dict(
        _delete_=True,
        type="MixedSemanticKITTI",
        split=["train", "val", "test"],
        data_root="data/semantic_kitti",
        transform=transform,
        mixture=dict(synthetic="/data/bank", ratio=0.5, labels="none"),
    )
)
hooks = [
    dict(type="SynthEpoch"),
    dict(type="CheckpointLoader"),
    dict(type="ModelHook"),
    dict(type="WeightDecaySchedular", base_value=0.04, final_value=0.2),
    dict(type="IterationTimer", warmup_iter=2),
    dict(type="InformationWriter"),
    dict(type="CheckpointSaver", save_freq=5),
]
