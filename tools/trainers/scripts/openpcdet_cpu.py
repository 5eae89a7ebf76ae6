"""OpenPCDet's own scripts on a machine without a GPU, with their evaluation::

    cd OpenPCDet/tools
    python /path/to/openpcdet_cpu.py train.py --cfg_file ...

spconv is the one from the package index. OpenPCDet's functions for a CPU are compiled from its
sources (``openpcdet_cpu.cpp``), and numba's simulator runs the kernels of KITTI's evaluation. Two
functions that OpenPCDet has for GPUs only are written here from its overlaps of boxes for a CPU:
non-maximum suppression, and the overlaps of its recall. Everything else that it compiles with nvcc
can be imported and not called.

Prints the scans of each batch.
"""

import os
import sys
import time
from pathlib import Path
from types import ModuleType
from typing import Any

os.environ.setdefault("NUMBA_ENABLE_CUDASIM", "1")  # before anything imports numba

import spconv.pytorch  # noqa: F401 - the launcher looks whether it is there
import torch
from cpu_torchvision import import_torchvision
from torch.utils.cpp_extension import load

NEEDS_GPU = (
    "roipoint_pool3d.roipoint_pool3d_cuda",
    "bev_pool.bev_pool_ext",
    "ingroup_inds.ingroup_inds_cuda",
    "pointnet2.pointnet2_stack.pointnet2_stack_cuda",
    "pointnet2.pointnet2_batch.pointnet2_batch_cuda",
)
"""Operators that stock PointPillars, SECOND and CenterPoint import and do not call."""


def prepare(tree: Path) -> None:
    """Make a checkout of OpenPCDet importable, built or not.

    Args:
        tree: the checkout; only read.
    """
    sys.path[:0] = [str(tree), str(tree / "tools")]
    import_torchvision()
    compiled = compile_functions(tree)
    if not (tree / "pcdet" / "version.py").exists():  # setup.py writes it
        _module("pcdet.version", __version__="0.6.0")
    for name in NEEDS_GPU:
        _module(f"pcdet.ops.{name}")
    # Imports av2 and kornia for its own data.
    _module("pcdet.datasets.argo2.argo2_dataset", Argo2Dataset=None)
    functions = {
        name: value
        for name, value in vars(compiled).items()
        if not name.startswith("__")
    }
    _module("pcdet.ops.roiaware_pool3d.roiaware_pool3d_cuda", **functions)
    overlaps = Overlaps(compiled.boxes_iou_bev_cpu)
    functions |= {"nms_gpu": overlaps.suppress, "boxes_overlap_bev_gpu": overlaps.areas}
    _module("pcdet.ops.iou3d_nms.iou3d_nms_cuda", **functions)


def _module(name: str, **content: Any) -> None:
    sys.modules[name] = ModuleType(name)
    vars(sys.modules[name]).update(content)


def compile_functions(tree: Path) -> Any:
    """Compile OpenPCDet's functions for a CPU, once for each version of torch; takes half a
    minute."""
    cache = Path(
        os.environ.get(
            "TORCH_EXTENSIONS_DIR", Path.home() / ".cache" / "torch_extensions"
        )
    )
    folder = cache / f"openpcdet_cpu_{torch.__version__}"
    # its sources for a CPU include CUDA's headers without use
    headers = folder / "include"
    headers.mkdir(parents=True, exist_ok=True)
    for name in ("cuda.h", "cuda_runtime_api.h"):
        if not (headers / name).exists():
            (headers / name).touch()
    operators = tree / "pcdet" / "ops"
    os.environ["PATH"] = (
        f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"  # ninja is there
    )
    return load(
        "openpcdet_cpu",
        [str(Path(__file__).with_suffix(".cpp"))],
        extra_cflags=["-O1", "-w"],
        extra_include_paths=[
            str(headers),
            str(operators),
            str(operators / "iou3d_nms" / "src"),
        ],
        build_directory=str(folder),
    )


class Overlaps:
    """What OpenPCDet computes on a GPU from the overlaps of boxes (N, 7), by its function for a
    CPU."""

    def __init__(self, boxes_iou_bev_cpu: Any) -> None:
        self._compute = boxes_iou_bev_cpu

    def ratios(self, boxes: Any, others: Any) -> Any:
        """(N, M) intersection over union seen from above."""
        out = torch.zeros(len(boxes), len(others))
        self._compute(
            boxes[:, :7].float().contiguous(), others[:, :7].float().contiguous(), out
        )
        return out

    def suppress(self, boxes: Any, keep: Any, threshold: float) -> int:
        """Greedy non-maximum suppression of boxes that are sorted by score; fills ``keep`` and
        counts them."""
        near = self.ratios(boxes, boxes) > threshold
        left = torch.ones(len(boxes), dtype=torch.bool)
        count = 0
        for i in range(len(boxes)):
            if left[i]:
                keep[count] = i
                count += 1
                left &= ~near[i]
        return count

    def areas(self, boxes: Any, others: Any, out: Any) -> None:
        """Fill (N, M) with the areas of intersection in square metres."""
        ratio = self.ratios(boxes, others)
        ours = boxes[:, 3] * boxes[:, 4]
        theirs = others[:, 3] * others[:, 4]
        both = ours[:, None] + theirs
        out.copy_(ratio * both / (1 + ratio))


def main() -> None:
    """Run the script on the command line through the package's launcher, as a user does."""
    tools = Path(sys.argv[1]).resolve().parent
    prepare(tools.parent)
    os.environ["LIDAR_SYNTH_CPU"] = "1"
    torch.cuda.FloatTensor = torch.FloatTensor
    wait = time.sleep
    # Evaluation waits for checkpoints.
    time.sleep = lambda seconds: wait(min(seconds, 0.1))  # type: ignore[assignment]

    import pcdet.config
    import pcdet.models
    from lidar_synth.integrations.openpcdet import main as launch

    pcdet.config.cfg.ROOT_DIR = Path(os.environ.get("OPENPCDET_OUTPUT", tools.parent))
    to_gpu = pcdet.models.load_data_to_gpu

    def shown(batch: Any) -> None:
        print(f"batch of {list(map(str, batch['frame_id']))}", flush=True)
        to_gpu(batch)

    pcdet.models.load_data_to_gpu = shown
    launch()


if __name__ == "__main__":
    main()
