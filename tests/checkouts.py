"""Checkouts of trainers' public code, given by environment variables, and stand-ins for what they compile."""

import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from lidar_synth.integrations.mixture import VARIABLE


def checkout(variable: str, what: str) -> Path:
    """The folder that a variable names; the whole test file is skipped where it is not set."""
    value = os.environ.get(variable)
    if not value:
        pytest.skip(f"{variable} is not set to a checkout of {what}", allow_module_level=True)
    path = Path(value)
    if not path.is_dir():
        raise FileNotFoundError(f"{variable}={value} leads to no folder")
    return path


def launch(trainer: str, *arguments: str, cwd: Path, mixture: Path) -> str:
    """What a trainer's own script says, run by ``launch.py``; its failure fails the test."""
    command = [sys.executable, str(Path(__file__).parent / "launch.py"), trainer, *arguments]
    done = subprocess.run(
        command, cwd=cwd, env=os.environ | {VARIABLE: str(mixture)}, capture_output=True, text=True, check=False
    )
    print(done.stdout, done.stderr)
    assert done.returncode == 0, "see what it said"
    return done.stdout + done.stderr


def stand_in(name: str, **content: Any) -> ModuleType:
    """A module of that name, unless there is a real one; whatever else is asked of it is a class that does nothing."""
    try:
        __import__(name)
        return sys.modules[name]
    except Exception:  # an installed library may fail in its own way (a missing .so)
        module = ModuleType(name)
    module.__dict__.update(content)
    module.__path__ = []
    module.__getattr__ = _anything  # type: ignore[method-assign]
    sys.modules[name] = module
    parent, _, child = name.rpartition(".")
    if parent in sys.modules:
        setattr(sys.modules[parent], child, module)
    return module


def _anything(name: str) -> Any:
    if name.startswith("__"):
        raise AttributeError(name)
    return type(name, (), {})


def points_in_boxes(boxes: Any, points: Any, out: Any) -> None:
    """``roiaware_pool3d_cuda.points_in_boxes_cpu``: (M, N) which points each box holds."""
    from lidar_synth.geometry.scan import Boxes

    held = Boxes(boxes.numpy(), ("",) * len(boxes)).contain(points.numpy())
    out.copy_(type(out)(held.astype(np.int32)))


def overlaps(boxes: Any, others: Any, out: Any) -> None:
    """``iou3d_nms_cuda.boxes_iou_bev_cpu``, as far as GT sampling asks: 1 where two boxes share ground, else 0."""
    from lidar_synth.labels.boxes import overlapping

    for i, box in enumerate(boxes.numpy()):
        if len(others):
            out[i] = type(out)(overlapping(box, others.numpy()).astype(np.float32))


class Voxels:
    """``spconv.utils.VoxelGeneratorV2``: points by the cell of a grid, up to so many of each."""

    def __init__(self, voxel_size: Any, point_cloud_range: Any, max_num_points: int, max_voxels: int) -> None:
        self.size, self.low, self.high = np.array(voxel_size), point_cloud_range[:3], point_cloud_range[3:]
        self.points, self.voxels = max_num_points, max_voxels

    def generate(self, points: Any) -> tuple[Any, Any, Any]:
        """(V, P, C) points, zeros where there are fewer; (V, 3) z, y, x of each voxel; (V,) how many points it has."""
        points = points[((points[:, :3] >= self.low) & (points[:, :3] < self.high)).all(1)]
        cells = ((points[:, 2::-1] - self.low[::-1]) / self.size[::-1]).astype(np.int32)
        cells, voxel, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
        order = np.argsort(voxel, kind="stable")
        place = np.empty(len(points), int)
        place[order] = np.arange(len(points)) - np.repeat(np.cumsum(counts) - counts, counts)
        kept = place < self.points
        held = np.zeros((len(cells), self.points, points.shape[1]), np.float32)
        held[voxel[kept], place[kept]] = points[kept]
        first = slice(self.voxels)
        return held[first], cells[first], np.minimum(counts, self.points).astype(np.int32)[first]


def openpcdet_stand_ins() -> None:
    """What OpenPCDet imports without use on a CPU, and what its data code and PointPillars call that is compiled."""
    for name in ("SharedArray", "torchvision", "kornia"):
        stand_in(name)
    stand_in("pcdet.version", __version__="0.6.0")
    for name in ("nuscenes.nuscenes", "waymo.waymo", "pandaset.pandaset", "lyft.lyft", "once.once", "argo2.argo2"):
        sys.modules[f"pcdet.datasets.{name}_dataset"] = stand_in(f"stands_for_{name.rpartition('.')[2]}")
    stand_in("pcdet.ops.iou3d_nms.iou3d_nms_cuda", boxes_iou_bev_cpu=overlaps)
    stand_in("pcdet.ops.roiaware_pool3d.roiaware_pool3d_cuda", points_in_boxes_cpu=points_in_boxes)
    for name in (
        "roipoint_pool3d.roipoint_pool3d_cuda", "bev_pool.bev_pool_ext", "ingroup_inds.ingroup_inds_cuda",
        "pointnet2.pointnet2_stack.pointnet2_stack_cuda", "pointnet2.pointnet2_batch.pointnet2_batch_cuda",
    ):  # fmt: skip
        stand_in(f"pcdet.ops.{name}")
    stand_in("spconv", __version__="2.3")
    stand_in("spconv.pytorch")
    stand_in("spconv.utils", VoxelGeneratorV2=Voxels)


def bare_package(name: str, folder: Path) -> None:
    """A package whose modules can be imported one by one, without what its ``__init__`` would import as well."""
    module = ModuleType(name)
    module.__path__ = [str(folder)]
    sys.modules[name] = module
