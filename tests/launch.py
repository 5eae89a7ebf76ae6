# ruff: noqa: E402, NPY001 - imports wait for their folder; Cylinder3D is of numpy's older days
"""Runs a trainer's own training script through our launcher, as a user types it, on a machine without a GPU::

    cd OpenPCDet/tools; python /path/to/tests/launch.py openpcdet train.py --cfg_file ...
    cd Cylinder3D; python /path/to/tests/launch.py cylinder3d train_cylinder_asym.py --config_path ...

What those trainers compile for CUDA is stood in for by ``checkouts`` and ``dense_spconv``, and what they send to a GPU
stays where it is; everything else is their own code. Prints what each batch (OpenPCDet) or each epoch (Cylinder3D) is
made of.
"""

import sys
import time
from collections import Counter
from functools import wraps
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parent.parent / "tools" / "stand_ins")]
from checkouts import openpcdet_stand_ins, stand_in


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


class Document(dict[str, Any]):
    """``strictyaml``'s: a configuration that is not held against its schema."""

    def __init__(self, text: str, schema: Any = None) -> None:
        super().__init__(yaml.safe_load(text))
        self.data = self


def cylinder3d() -> None:
    """Cylinder3D's ``train_cylinder_asym.py``."""
    sys.path.insert(0, str(Path(sys.argv[1]).resolve().parent))
    np.int = int  # type: ignore[attr-defined]
    schema = dict.fromkeys(("Map", "Seq", "Bool", "Int", "Float", "Str"), lambda *parts: None)
    stand_in("strictyaml", load=Document, **schema)
    import dense_spconv

    sys.modules.setdefault("spconv", dense_spconv)
    wait = time.sleep
    time.sleep = lambda seconds: wait(min(seconds, 0.1))  # it waits ten seconds before each epoch
    from lidar_synth.integrations.cylinder3d import main, register

    mixed = register()
    tell = mixed.set_epoch

    def told(self: Any, epoch: int) -> None:
        tell(self, epoch)
        if self.mixed is not None:
            print(f"epoch {epoch} of {dict(Counter(self.mixed.domain(i) for i in range(len(self))))}", flush=True)

    mixed.set_epoch = told
    main()


if __name__ == "__main__":
    trainer = {"openpcdet": openpcdet, "cylinder3d": cylinder3d}[sys.argv.pop(1)]
    without_gpu()
    trainer()
