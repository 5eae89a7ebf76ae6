# ruff: noqa: C408
# MinkUNet with LaserMix and PolarMix on SemanticKITTI, real and synthetic: only the stock one's
# training data changes. The list is written by lidar_synth.integrations.mmdet3d_infos.write_infos;
# see docs/how-to/trainers/mmdetection3d.md.
_base_ = [
    "mmdet3d::minkunet/minkunet34_w32_spconv_8xb2-laser-polar-mix-3x_semantickitti.py"
]

custom_imports = dict(
    imports=["lidar_synth.integrations.mmdet3d"], allow_failed_imports=False
)
custom_hooks = [dict(type="SynthEpochHook")]

train_dataloader = dict(
    sampler=dict(type="SynthSampler"),
    dataset=dict(data_root="", ann_file="data/semantickitti_mixed/infos.json"),
)
