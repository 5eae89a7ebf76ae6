"""What an adapter adds to a trainer's own loading of a real sample, and what a synthetic sample costs beside it.

Measured in turns by processor time, on MMDetection3D's stock SemanticKITTI pipeline (points, labels, flip, turn, pack),
with scans of the town in SemanticKITTI's layout; needs an environment of ``tools/install_mmdet3d.sh``::

    python tools/bench/trainers.py
"""

import sys
import tempfile
import time
from importlib.util import find_spec
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).parents[2] / "tests"))

from timing import print_table, time_in_turns

SCANS = 8


def datasets(root: Path) -> tuple[Any, Any]:
    """The stock dataset and the mixed one, of the same real scans."""
    from lidar_synth.integrations.mmdet3d_infos import write_infos
    from lidar_synth.integrations.mmdet3d_lists import semantic_kitti_list
    from mmdet3d.registry import DATASETS
    from mmengine.config import Config
    from mmengine.registry import init_default_scope

    from lidar_synth.convert import convert
    from lidar_synth.formats import WRITERS
    from lidar_synth.town import Town, export_town

    export_town(Town(seed=1, scans=SCANS), root / "real", "semantic_kitti", camera=False, progress=False)
    convert(Town(seed=2, scans=SCANS), WRITERS["npz"](root / "synthetic"), progress=False)
    listed = semantic_kitti_list(root / "real", root / "real" / "train.json")
    settings = {"synthetic": root / "synthetic", "ratio": 0.5}
    mixed = write_infos(root / "mixed", listed, settings, data_root=root / "real")
    init_default_scope("mmdet3d")
    config = Config.fromfile(str(Path(__file__).parents[2] / "configs/mmdet3d/minkunet_semantickitti.py"))
    ours = config.train_dataloader.dataset.to_dict() | {"ann_file": str(mixed)}
    ours["pipeline"] = [*ours["pipeline"][:3], *ours["pipeline"][-2:]]  # without partners drawn at random
    theirs = ours | {"ann_file": str(listed), "data_root": str(root / "real")}
    return DATASETS.build(theirs), DATASETS.build(ours)


def main() -> None:
    """Prints one table."""
    if find_spec("mmdet3d") is None:
        print("mmdet3d is not installed (tools/install_mmdet3d.sh): nothing measured")
        return
    import mmcv_ext

    mmcv_ext.install()
    with tempfile.TemporaryDirectory() as folder:
        stock, mixed = datasets(Path(folder))
        slots = iter(range(10**9))
        own = "a real sample, the trainer's own dataset"
        calls = {
            own: lambda: stock[0],
            "the same through the mixed list": lambda: mixed[0],
            "a synthetic sample, from a folder of .npz": lambda: mixed[SCANS + next(slots) % SCANS],
        }
        seconds = time_in_turns(calls, rounds=40, clock=time.process_time)
        print_table("MMDetection3D, SemanticKITTI, one sample", seconds, own)


if __name__ == "__main__":
    main()
