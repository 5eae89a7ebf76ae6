"""Prepare short trainings of MMDetection3D: lists, mixed lists, databases of objects, and short
configurations.

    python tools/trainers/scripts/mmdet3d_prepare.py OUT [CONFIG ...] --kitti KITTI
        --nuscenes NUSCENES [--frame NUSCENES_FRAME]

Datasets are copied to OUT/data, where the stock configurations look for them; run the trainer in
OUT. KITTI is mixed with generated scans of its own layouts, which have boxes, the other datasets
with scans of the town. ``--frame`` names a folder of one real nuScenes key frame with the trainer's
``info.json``.
"""

import json
import shutil
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

from lidar_synth.integrations.detection import write_gt_database
from lidar_synth.integrations.folders import write_planes
from lidar_synth.integrations.mmdet3d_infos import write_infos
from lidar_synth.integrations.mmdet3d_lists import kitti_list
from lidar_synth.integrations.mmdet3d_nuscenes import nuscenes_list
from mmengine.config import Config
from typer import Argument, run

from lidar_synth.formats import WRITERS, open_scans
from lidar_synth.formats.convert import convert
from lidar_synth.lab.town import Town
from lidar_synth.labels import ObjectBank

CONFIGS = Path(__file__).parents[3] / "configs" / "mmdet3d"
MIX = {"ratio": 0.5, "seed": 0}
SPCONV_ON_CPU = ("centerpoint_voxel_nuscenes.py",)
"""Configurations whose sparse convolutions need ``spconv_on_cpu``."""


def prepare_kitti(out: Path, scans: int) -> None:
    """The lists of ``data/kitti``, the mixed one, and the database of objects."""
    root = out / "data" / "kitti"
    write_planes(root, "trainval")
    for split in ("train", "val"):
        kitti_list(root, root / f"kitti_infos_{split}.pkl", split)
    where = {"data_root": root, "points": "training/velodyne_reduced"}
    settings = MIX | {
        "synthetic": layouts(out / "layouts", scans, root),
        "labels": "boxes",
    }
    write_infos(
        out / "data" / "kitti_mixed", root / "kitti_infos_train.pkl", settings, **where
    )
    objects = ObjectBank.from_scans(open_scans(town(out / "synthetic", scans, "town")))
    write_gt_database(
        objects,
        root,
        origin="bottom",
        folder="kitti_gt_database",
        infos="kitti_dbinfos_train.pkl",
    )


def prepare_nuscenes(out: Path, scans: int, frame: Path | None) -> None:
    """The lists of ``data/nuscenes`` with one more real key frame, the mixed one, and the database
    of objects."""
    root = out / "data" / "nuscenes"
    for split in ("train", "val"):
        nuscenes_list(root, root / f"nuscenes_infos_{split}.pkl", split, "v1.0-mini")
    listed = root / "nuscenes_infos_train.pkl"
    if frame is not None:
        listed = with_frame(
            nuscenes_list(root, root / "town.json", "train", "v1.0-mini"), frame, root
        )
    made = town(out / "synthetic32", scans, "hdl32e_nuscenes")
    where = {
        "data_root": root,
        "points": "samples/LIDAR_TOP",
        "sweeps": "sweeps/LIDAR_TOP",
    }
    write_infos(
        out / "data" / "nuscenes_mixed",
        listed,
        MIX | {"synthetic": made},
        balance=True,
        **where,
    )
    objects = ObjectBank.from_scans(open_scans(made))
    write_gt_database(
        objects,
        root,
        origin="bottom",
        folder="nuscenes_gt_database",
        infos="nuscenes_dbinfos_train.pkl",
        layout="nuscenes",
    )


def with_frame(listed: Path, frame: Path, root: Path) -> Path:
    """Add a real key frame to a list, and its scan to the dataset."""
    content = json.loads(listed.read_text())
    real = json.loads((frame / "info.json").read_text())
    content["data_list"] += real["data_list"]
    listed.write_text(json.dumps(content))
    for path in (frame / "samples" / "LIDAR_TOP").iterdir():
        shutil.copy(path, root / "samples" / "LIDAR_TOP")
    return listed


def town(out: Path, scans: int, sensor: str) -> Path:
    """A folder of synthetic scans of the town."""
    if not out.is_dir():
        convert(Town(seed=2, sensor=sensor, scans=scans), WRITERS["npz"](out))
    return out


def layouts(out: Path, scans: int, kitti: Path) -> Path:
    """A bank of generated scans with boxes, those of KITTI's scans."""
    if not out.is_dir():
        bake = [
            sys.executable,
            "-m",
            "lidar_synth",
            "bake",
            out,
            "--model",
            "town-layout",
            "--count",
            str(scans),
        ]
        subprocess.run(
            [*bake, "--condition", kitti, "--condition-layout", "kitti_object"],
            check=True,
        )
    return out


def shorten(
    name: str,
    out: Path,
    iterations: int = 4,
    batch_size: int = 1,
    extra: Iterable[str] = (),
) -> Path:
    """Write a configuration of ours with few iterations, small batches and one worker; the network
    is the stock one.

    Args:
        name: the file in ``configs/mmdet3d``.
        out: output folder.
        iterations: of training; a checkpoint is written in the middle and at the end, where
            validation follows.
        batch_size: of training.
        extra: further modules to import.
    """
    config = Config.fromfile(str(CONFIGS / name))
    loader = config.train_dataloader
    loader.update(batch_size=batch_size, num_workers=1)
    dataset = loader.dataset
    if dataset.type == "RepeatDataset":
        dataset = dataset.dataset
    for step in dataset.pipeline:
        if step.type == "ObjectSample":
            few_objects(step.db_sampler)
    few_iterations(config, iterations)
    if "mmdet3d_report" in extra:
        config.custom_hooks = [*config.custom_hooks, {"type": "Report"}]
    config.custom_imports.imports = [*extra, *config.custom_imports.imports]
    if "nuscenes" in name:
        config.val_dataloader.dataset.metainfo.version = "v1.0-mini"
    config.dump(out / name)
    return out / name


def few_objects(sampler: Any) -> None:
    """Restrict a database sampler to cars, which every street has; the stock one stops at a class
    without objects."""
    kept = [name for name in sampler.classes if name in ("Car", "car")]
    sampler.classes = kept
    sampler.sample_groups = dict.fromkeys(kept, 2)
    sampler.prepare = {
        "filter_by_difficulty": [],
        "filter_by_min_points": dict.fromkeys(kept, 5),
    }


def few_iterations(config: Any, count: int) -> None:
    """Restrict a configuration to a number of iterations, each with a line in the log."""
    loop = {"max_iters": count, "val_interval": count}
    config.train_cfg = {"type": "IterBasedTrainLoop"} | loop
    config.param_scheduler = []
    wrapper = config.optim_wrapper
    if wrapper.type == "AmpOptimWrapper":  # mixed precision is a GPU's
        wrapper = {"type": "OptimWrapper", "optimizer": wrapper.optimizer}
        config.optim_wrapper = wrapper
    hooks = config.default_hooks
    hooks.logger = {"type": "LoggerHook", "interval": 1}
    saving = {"interval": count // 2, "by_epoch": False}
    hooks.checkpoint = {"type": "CheckpointHook"} | saving
    config.log_processor = {"type": "LogProcessor", "window_size": 1, "by_epoch": False}


def main(
    out: Path,
    configs: Annotated[list[str] | None, Argument()] = None,
    kitti: Path | None = None,
    nuscenes: Path | None = None,
    frame: Path | None = None,
    scans: int = 4,
) -> None:
    """Writes the lists of so many synthetic scans, and shortens configurations."""
    out = out.resolve()
    given = {"kitti": kitti, "nuscenes": nuscenes}
    for name, root in given.items():
        if root is not None:
            shutil.copytree(root, out / "data" / name)
    if kitti:
        prepare_kitti(out, scans)
    if nuscenes:
        prepare_nuscenes(out, scans, frame)
    for name in configs or ():
        extra = ("spconv_on_cpu",) if name in SPCONV_ON_CPU else ()
        shorten(name, out, extra=("mmdet3d_report", *extra))


if __name__ == "__main__":
    run(main)
