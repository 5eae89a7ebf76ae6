"""Train stock PointPillars and FRNet for a few iterations on real and synthetic scans, and print the losses.

The synthetic scans are from the town. The real ones are copied from the given folders of KITTI and SemanticKITTI;
without folders they are other scans of the town in these layouts. This shows that the trainer accepts the mixture, not
that the mixture helps. ``try_mmdet3d.sh`` runs it.
"""

import argparse
import os
import shutil
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from lidar_synth.integrations.detection import write_gt_database
from lidar_synth.integrations.folders import write_planes
from lidar_synth.integrations.mmdet3d_infos import write_infos
from lidar_synth.integrations.mmdet3d_lists import kitti_list, semantic_kitti_list
from mmengine.config import Config
from mmengine.hooks import Hook
from mmengine.registry import HOOKS, init_default_scope
from mmengine.runner import Runner

from lidar_synth.formats import WRITERS, open_scans
from lidar_synth.formats.convert import convert
from lidar_synth.labels import ObjectBank
from lidar_synth.town import Town, export_town

CONFIGS = Path(__file__).parent.parent / "configs" / "mmdet3d"


@HOOKS.register_module()
class Report(Hook):  # type: ignore[misc]
    """Prints each iteration's loss and which of its scans were synthetic."""

    def after_train_iter(self, runner: Any, batch_idx: int, data_batch: Any = None, outputs: Any = None) -> None:
        losses = {key: float(np.asarray(value.detach())) for key, value in outputs.items()}
        kinds = Counter(
            "synthetic" if str(s.lidar_path).startswith("lsynth://") else "real" for s in data_batch["data_samples"]
        )
        print(f"epoch {runner.epoch} iteration {runner.iter + 1}: loss {losses['loss']:.3f}, {dict(kinds)}", flush=True)


def prepare(out: Path, scans: int, real: dict[str, Path | None]) -> None:
    """Write datasets, lists and the GT database to ``out``; ``real`` has a folder or None for each layout."""
    for layout, given in real.items():
        if given is None:
            export_town(Town(seed=1, scans=scans), out / layout, layout, camera=False)
        else:
            shutil.copytree(given, out / layout)  # planes and points in the camera's view are written beside the scans
    made = out / "synthetic"
    convert(Town(seed=2, scans=scans), WRITERS["npz"](made))
    settings = {"synthetic": made, "ratio": 0.5, "seed": 0}
    write_planes(out / "kitti", "train")
    kitti_list(out / "kitti", out / "kitti" / "train.json")
    write_infos(
        out / "det", out / "kitti" / "train.json", settings, data_root=out / "kitti", points="training/velodyne_reduced"
    )
    objects = ObjectBank.from_scans(open_scans(made))
    write_gt_database(objects, out / "kitti", origin="bottom", folder="kitti_gt_database", infos="dbinfos.pkl")
    semantic_kitti_list(out / "semantic_kitti", out / "semantic_kitti" / "train.json")
    root = {"data_root": out / "semantic_kitti"}
    write_infos(out / "seg", out / "semantic_kitti" / "train.json", settings, **root)


def train(name: str, folder: Path, iterations: int, batch_size: int, gt_root: Path) -> None:
    """A few iterations of a configuration on the mixed list in a folder."""
    config = Config.fromfile(str(CONFIGS / name))
    loader = config.train_dataloader
    dataset = loader.dataset.dataset if loader.dataset.type == "RepeatDataset" else loader.dataset
    dataset.ann_file = str(folder / "infos.json")
    loader.update(batch_size=batch_size, num_workers=1)
    for step in dataset.pipeline:
        if step.type == "ObjectSample":
            step.db_sampler.update(data_root=str(gt_root), info_path=str(gt_root / "dbinfos.pkl"))
    dataset.pipeline[-1].meta_keys = ("lidar_path", "num_points", "box_type_3d", "box_mode_3d")
    config.train_cfg = {"type": "IterBasedTrainLoop", "max_iters": iterations, "val_interval": 10**6}
    config.optim_wrapper = {"type": "OptimWrapper", "optimizer": {"type": "AdamW", "lr": 1e-3}}
    config.param_scheduler = []
    for key in ("val_cfg", "val_dataloader", "val_evaluator", "test_cfg", "test_dataloader", "test_evaluator"):
        config[key] = None
    config.custom_hooks = [*config.custom_hooks, {"type": "Report"}]
    config.work_dir = str(folder / "work")
    config.default_hooks.checkpoint = None
    config.log_level = "WARNING"
    init_default_scope("mmdet3d")
    print(f"{name}: {config.model.type}, {iterations} iterations of {batch_size} scans", flush=True)
    Runner.from_cfg(config).train()


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path, help="folder for the scans")
    parser.add_argument("--iterations", type=int, default=4)
    parser.add_argument("--scans", type=int, default=8, help="scans of the town, real and synthetic each")
    parser.add_argument("--kitti", type=Path, help="KITTI's object set, with training and ImageSets")
    parser.add_argument("--semantic-kitti", type=Path, help="SemanticKITTI's dataset, with sequences")
    parser.add_argument("--batch-size", type=int, default=2)
    parser.add_argument("--only", choices=["pointpillars", "frnet"], help="one of the two")
    options = parser.parse_args()
    out = options.out.resolve()
    if not (out / "seg" / "infos.json").is_file():
        prepare(out, options.scans, {"kitti": options.kitti, "semantic_kitti": options.semantic_kitti})
    if options.only != "frnet":
        train("pointpillars_kitti.py", out / "det", options.iterations, options.batch_size, out / "kitti")
    if options.only == "pointpillars":
        return
    if os.environ.get("FRNET_ROOT"):
        train("frnet_semantickitti.py", out / "seg", options.iterations, options.batch_size, out / "kitti")
    else:
        print("FRNET_ROOT is not set to a checkout of FRNet: skipped")


if __name__ == "__main__":
    main()
