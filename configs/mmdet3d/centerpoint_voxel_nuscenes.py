# ruff: noqa: C408
# CenterPoint (voxels) on nuScenes, real and synthetic: only the training data of the stock one
# changes. The list is balanced by class beforehand (write_infos(..., balance=True)), because
# CBGSDataset would change the ratio. The list is written by
# lidar_synth.integrations.mmdet3d_infos.write_infos; see docs/how-to/trainers/mmdetection3d.md.
_base_ = [
    "mmdet3d::centerpoint/centerpoint_voxel01_second_secfpn_8xb4-cyclic-20e_nus-3d.py"
]

custom_imports = dict(
    imports=["lidar_synth.integrations.mmdet3d"], allow_failed_imports=False
)
custom_hooks = [dict(type="SynthEpochHook")]

train_dataloader = dict(
    sampler=dict(type="SynthSampler"),
    dataset=dict(
        _delete_=True,
        type="SynthNuScenesDataset",
        data_root="",
        ann_file="data/nuscenes_mixed/infos.json",
        data_prefix=dict(pts="", sweeps=""),
        pipeline={{_base_.train_dataloader.dataset.dataset.pipeline}},
        metainfo={{_base_.train_dataloader.dataset.dataset.metainfo}},
        use_valid_flag=True,
        filter_empty_gt=False,
        box_type_3d="LiDAR",
    ),
)
