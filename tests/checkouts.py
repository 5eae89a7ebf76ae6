"""Checkouts of trainers' public code, given by environment variables, and stand-ins for what they compile."""

import os
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest


def checkout(variable: str, what: str) -> Path:
    """The folder that a variable names; the whole test file is skipped where it is not set."""
    value = os.environ.get(variable)
    if not value:
        pytest.skip(f"{variable} is not set to a checkout of {what}", allow_module_level=True)
    path = Path(value)
    if not path.is_dir():
        raise FileNotFoundError(f"{variable}={value} leads to no folder")
    return path


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
    from lidar_synth.scan import Boxes

    held = Boxes(boxes.numpy(), ("",) * len(boxes)).contain(points.numpy())
    out.copy_(type(out)(held.astype(np.int32)))


def overlaps(boxes: Any, others: Any, out: Any) -> None:
    """``iou3d_nms_cuda.boxes_iou_bev_cpu``, as far as GT sampling asks: 1 where two boxes share ground, else 0."""
    from lidar_synth.labels.boxes import overlapping

    for i, box in enumerate(boxes.numpy()):
        if len(others):
            out[i] = type(out)(overlapping(box, others.numpy()).astype(np.float32))


def bare_package(name: str, folder: Path) -> None:
    """A package whose modules can be imported one by one, without what its ``__init__`` would import as well."""
    module = ModuleType(name)
    module.__path__ = [str(folder)]
    sys.modules[name] = module
