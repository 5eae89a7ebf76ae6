"""Labels per scan recovered for KITTI-360 from its accumulated clouds."""
