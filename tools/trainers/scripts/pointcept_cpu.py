"""Pointcept's own scripts on a machine without a GPU, with their evaluation::

    cd Pointcept
    python /path/to/pointcept_cpu.py tools/train.py --config-file ... --options ...

spconv is the one from the package index. What Pointcept compiles for CUDA only, pointops and
pointgroup_ops, comes from ``tools/stand_ins``; so do torch_scatter and torch_cluster, unless they
are installed. What is sent to a GPU stays on the CPU.

Prints the name of each training sample and the epoch of its mixture.
"""

import runpy
import sys
from pathlib import Path
from typing import Any

import spconv.pytorch  # noqa: F401 - stay_on_cpu looks whether it is there
import torch
from cpu_torchvision import import_torchvision


def prepare(tree: Path) -> None:
    """Make a checkout of Pointcept importable.

    Args:
        tree: the checkout; only read.
    """
    stand_ins = Path(__file__).parent.parent.parent / "stand_ins"
    sys.path.insert(0, str(tree))
    sys.path.append(str(stand_ins))  # after what is installed
    import_torchvision()


def main() -> None:
    """Run the script on the command line."""
    prepare(Path.cwd())
    from lidar_synth.integrations.launcher import stay_on_cpu

    stay_on_cpu()
    storage = torch.UntypedStorage
    storage.cuda = lambda self, *args, **options: self  # type: ignore[method-assign,assignment]
    # integers on a GPU only, and Pointcept's evaluation counts classes
    count = torch.histc
    torch.histc = lambda values, *args, **options: count(
        values.float(), *args, **options
    )  # type: ignore[assignment]
    from lidar_synth.integrations.pointcept import MixedSemanticKITTI

    read = MixedSemanticKITTI.get_data

    def shown(self: Any, idx: int) -> Any:
        data = read(self, idx)
        # Workers print at once.
        print(f"epoch {self.mixed.epoch} sample {data['name']}\n", end="", flush=True)
        return data

    MixedSemanticKITTI.get_data = shown
    sys.argv = sys.argv[1:]
    runpy.run_path(sys.argv[0], run_name="__main__")


if __name__ == "__main__":
    main()
