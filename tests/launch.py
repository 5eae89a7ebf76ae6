# ruff: noqa: E402 - imports wait for their folder
"""Runs a trainer's own training script through our launcher, as a user types it, on a machine without a GPU::

    cd OpenPCDet/tools; python /path/to/tests/launch.py openpcdet train.py --cfg_file ...

What it compiles for CUDA is stood in for by ``checkouts``, and what it sends to a GPU stays where it is; everything
else is its own code. Prints what each batch is made of.
"""

import sys
from collections import Counter
from functools import wraps
from pathlib import Path
from typing import Any

import torch

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parent.parent / "tools" / "stand_ins")]
from checkouts import openpcdet_stand_ins


def without_gpu() -> None:
    """What is sent to a GPU stays on the CPU."""
    for kind in (torch.Tensor, torch.nn.Module):
        kind.cuda = lambda self, *args, **options: self  # type: ignore[attr-defined, method-assign]
        kind.to = _on_cpu(kind.to)  # type: ignore[attr-defined, method-assign]
    torch.Tensor.get_device = lambda self: self.device  # type: ignore[assignment, method-assign]


def _on_cpu(move: Any) -> Any:
    @wraps(move)
    def moved(self: Any, *args: Any, **options: Any) -> Any:
        left = [a for a in args if not (isinstance(a, torch.device) and a.type == "cuda")]
        return move(self, *left, **options) if left or options else self

    return moved


def openpcdet() -> None:
    """OpenPCDet's ``train.py`` in its ``tools``, with output in the folder of the configuration."""
    tools = Path(sys.argv[1]).resolve().parent
    sys.path[:0] = [str(tools.parent), str(tools)]
    openpcdet_stand_ins()
    import pcdet.config
    import pcdet.models
    import test
    from lidar_synth.integrations.openpcdet import main

    pcdet.config.cfg.ROOT_DIR = Path(sys.argv[sys.argv.index("--cfg_file") + 1]).resolve().parent
    load = pcdet.models.load_data_to_gpu

    def counted(batch: Any) -> None:
        kinds = Counter("synthetic" if str(n).startswith("synthetic/") else "real" for n in batch["frame_id"])
        print(f"batch of {dict(kinds)}", flush=True)
        load(batch)

    pcdet.models.load_data_to_gpu = counted
    test.repeat_eval_ckpt = lambda *args, **options: print("evaluation needs its compiled NMS: left out")
    main()


if __name__ == "__main__":
    trainer = {"openpcdet": openpcdet}[sys.argv.pop(1)]
    without_gpu()
    trainer()
