# ruff: noqa: C408
# FRNet on SemanticKITTI, real and synthetic: only the training data of the stock one changes.
# FRNET_ROOT is a checkout of FRNet's repository, which has to be on PYTHONPATH too.
# The list is written by lidar_synth.integrations.mmdet3d_infos.write_infos; see
# docs/how-to/trainers/mmdetection3d.md.
_base_ = ["{{$FRNET_ROOT:.}}/configs/frnet/frnet-semantickitti_seg.py"]

custom_imports = dict(
    imports=[
        "frnet.datasets",
        "frnet.datasets.transforms",
        "frnet.models",
        "lidar_synth.integrations.mmdet3d",
    ],
    allow_failed_imports=False,
)
custom_hooks = [dict(type="SynthEpochHook")]

train_dataloader = dict(
    sampler=dict(type="SynthSampler"),
    dataset=dict(data_root="", ann_file="data/semantickitti_mixed/infos.json"),
)
