# ruff: noqa: C408
# PointPillars on KITTI, real and synthetic: only the training data of the stock one changes.
# The list is written by lidar_synth.integrations.mmdet3d_infos.write_infos; see
# docs/how-to/trainers/mmdetection3d.md.
_base_ = ["mmdet3d::pointpillars/pointpillars_hv_secfpn_8xb6-160e_kitti-3d-3class.py"]

custom_imports = dict(
    imports=["lidar_synth.integrations.mmdet3d"], allow_failed_imports=False
)
custom_hooks = [dict(type="SynthEpochHook")]

train_dataloader = dict(
    sampler=dict(type="SynthSampler"),
    dataset=dict(
        dataset=dict(
            type="SynthKittiDataset",
            data_root="",
            ann_file="data/kitti_mixed/infos.json",
            data_prefix=dict(pts=""),
            filter_empty_gt=False,
        )
    ),
)
