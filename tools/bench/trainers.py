"""The time that an adapter adds to a trainer's loading of a real sample, and the time of a
synthetic sample.

Processor time, measured in turns, each trainer in its own process. MMDetection3D is measured where
it is installed (``tools/install_mmdet3d.sh``; stock SemanticKITTI pipeline: points, labels, flip,
rotation, packing; scans of the town). The others are measured where a variable names their
checkout, as for the tests, on the small scans of the tests, which make the adapter's share larger::

    OPENPCDET_ROOT=/path/to/OpenPCDet python tools/bench/trainers.py
"""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from itertools import cycle
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).parents[2] / "tests"))

from timing import print_table, time_in_turns

SCANS = 8
OWN = "a real sample, the trainer's own dataset"
MIXED = "the same through the mixture"
SYNTHETIC = "a synthetic sample, from a folder of .npz"
VARIABLES = {
    "openpcdet": "OPENPCDET_ROOT",
    "pointcept": "POINTCEPT_ROOT",
    "rangenet": "RANGENET_ROOT",
    "cylinder3d": "CYLINDER3D_ROOT",
    "open3d_ml": "OPEN3D_ML_ROOT",
}


def write_lists(root: Path) -> tuple[Path, Path]:
    """The trainer's own list of scans of the town, and the mixed one."""
    from lidar_synth.integrations.mmdet3d_infos import write_infos
    from lidar_synth.integrations.mmdet3d_lists import semantic_kitti_list

    from lidar_synth.formats import WRITERS
    from lidar_synth.formats.convert import convert
    from lidar_synth.lab.town import Town, export_town

    real = root / "real"
    quiet = {"camera": False, "progress": False}
    export_town(Town(seed=1, scans=SCANS), real, "semantic_kitti", **quiet)
    synthetic = root / "synthetic"
    convert(Town(seed=2, scans=SCANS), WRITERS["npz"](synthetic), progress=False)
    listed = semantic_kitti_list(real, real / "train.json")
    settings = {"synthetic": synthetic, "ratio": 0.5}
    return listed, write_infos(root / "mixed", listed, settings, data_root=real)


def mmdet3d(root: Path) -> dict[str, Callable[[], Any]]:
    """The stock dataset and the mixed one, with the same real scans."""
    import mmcv_ext

    mmcv_ext.install()
    from mmdet3d.registry import DATASETS
    from mmengine.config import Config
    from mmengine.registry import init_default_scope

    listed, mixed = write_lists(root)
    init_default_scope("mmdet3d")
    file = Path(__file__).parents[2] / "configs/mmdet3d/minkunet_semantickitti.py"
    config = Config.fromfile(str(file))
    ours = config.train_dataloader.dataset.to_dict() | {"ann_file": str(mixed)}
    steps = ours["pipeline"]
    ours["pipeline"] = steps[:3] + steps[-2:]  # without random partners
    theirs = ours | {"ann_file": str(listed), "data_root": str(root / "real")}
    stock = DATASETS.build(theirs)
    dataset = DATASETS.build(ours)
    slots = cycle(range(SCANS, 2 * SCANS))
    return {
        OWN: lambda: stock[0],
        MIXED: lambda: dataset[0],
        SYNTHETIC: lambda: dataset[next(slots)],
    }


def of_tests(trainer: str, root: Path) -> dict[str, Callable[[], Any]]:
    """The same for the datasets that a trainer's tests compare."""
    tests = import_module(f"test_integrations_{trainer}")
    own, ours = tests.both(tests.make(root))
    where = [
        next(i for i in range(len(ours)) if ours.mixed.domain(i) == domain)
        for domain in (0, 1)
    ]
    load = "get_data" if trainer == "open3d_ml" else "__getitem__"
    theirs = getattr(own, load)
    mine = getattr(ours, load)
    number = ours.mixed[where[0]]
    return {
        OWN: lambda: theirs(number),
        MIXED: lambda: mine(where[0]),
        SYNTHETIC: lambda: mine(where[1]),
    }


def main() -> None:
    """Prints a table for each installed trainer, or for the one that is named."""
    if sys.argv[1:]:
        with tempfile.TemporaryDirectory() as folder:
            calls = (
                mmdet3d(Path(folder))
                if sys.argv[1] == "mmdet3d"
                else of_tests(sys.argv[1], Path(folder))
            )
            print_table(
                f"{sys.argv[1]}, one sample",
                time_in_turns(calls, rounds=200, clock=time.process_time),
                OWN,
            )
        return
    for trainer in ("mmdet3d", *VARIABLES):
        if (
            os.environ.get(VARIABLES[trainer])
            if trainer in VARIABLES
            else find_spec(trainer)
        ):
            subprocess.run([sys.executable, __file__, trainer], check=True)
        else:
            print(f"{trainer} is not installed (docs/how-to/trainers/): not measured")


if __name__ == "__main__":
    main()
