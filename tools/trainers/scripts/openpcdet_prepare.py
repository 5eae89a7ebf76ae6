"""What OpenPCDet makes once from a dataset, on a machine without a GPU: info lists and the database
of GT sampling.

    python openpcdet_prepare.py TREE kitti|nuscenes FOLDER OBJECTS.npz

FOLDER is KITTI's object set with ``ImageSets``, or the folder that holds ``v1.0-mini``. KITTI's
planes are fitted where they are missing. OpenPCDet's sampler needs objects of every class, which so
few scans lack: the database of GT sampling is that of a bank of objects.
"""

import json
import pickle
import sys
from pathlib import Path
from typing import Any

from typer import run

sys.path.insert(0, str(Path(__file__).parent))
from openpcdet_cpu import prepare

VERSION = "v1.0-mini"
TABLES = ("sensor", "calibrated_sensor", "sample_data")


def main(
    tree: Path,
    kind: str,
    folder: Path,
    objects: Path,
) -> None:
    """Write the files beside the dataset."""
    prepare(tree)
    import torch
    import yaml
    from easydict import EasyDict

    from lidar_synth.labels import ObjectBank

    torch.Tensor.cuda = lambda self, *args, **kwargs: self  # type: ignore[method-assign]
    stock = tree / "tools" / "cfgs" / "dataset_configs" / f"{kind}_dataset.yaml"
    config = EasyDict(yaml.safe_load(stock.read_text()))
    {"kitti": prepare_kitti, "nuscenes": prepare_nuscenes}[kind](
        config, folder, ObjectBank.load(objects)
    )


def prepare_kitti(config: Any, folder: Path, objects: Any) -> None:
    """Info lists of both splits, GT database and planes."""
    from lidar_synth.integrations.detection import write_gt_database
    from lidar_synth.integrations.folders import write_planes
    from pcdet.datasets.kitti import kitti_dataset

    kitti_dataset.Path = Path  # it imports that only when it is run as a script
    write_planes(folder)
    for split in ("val", "train"):
        dataset = kitti_dataset.KittiDataset(
            config, ["Car", "Pedestrian", "Cyclist"], training=False, root_path=folder
        )
        dataset.set_split(split)
        file = folder / f"kitti_infos_{split}.pkl"
        file.write_bytes(pickle.dumps(dataset.get_infos(num_workers=1)))
    dataset.create_groundtruth_database(file, split="train")
    write_gt_database(
        objects, folder, origin="gravity", infos="kitti_dbinfos_train.pkl"
    )


def prepare_nuscenes(config: Any, folder: Path, objects: Any) -> None:
    """Info lists of both splits and GT database."""
    from pcdet.datasets.nuscenes.nuscenes_dataset import (
        NuScenesDataset,
        create_nuscenes_info,
    )
    from pcdet.utils.common_utils import create_logger

    add_camera(folder / VERSION / VERSION)
    create_nuscenes_info(VERSION, folder, folder, config.MAX_SWEEPS)
    config.VERSION = VERSION
    dataset = NuScenesDataset(
        config, None, training=True, root_path=folder, logger=create_logger()
    )
    dataset.create_groundtruth_database(max_sweeps=config.MAX_SWEEPS)
    names = [
        group.partition(":")[0]
        for group in config.DATA_AUGMENTOR.AUG_CONFIG_LIST[0].SAMPLE_GROUPS
    ]
    complete(
        folder / VERSION / f"nuscenes_dbinfos_{config.MAX_SWEEPS}sweeps_withvelo.pkl",
        names,
    )


def add_camera(folder: Path) -> None:
    """Add a front camera to nuScenes' tables that have none, because OpenPCDet reads its pose;
    there is no picture."""
    tables = {
        name: json.loads((folder / f"{name}.json").read_text()) for name in TABLES
    }
    if any(row["channel"] == "CAM_FRONT" for row in tables["sensor"]):
        return
    tables["sensor"].append(
        {"token": "camera", "channel": "CAM_FRONT", "modality": "camera"}
    )
    # Z ahead, x right, y down.
    pose = {"translation": [1.7, 0, 1.5], "rotation": [0.5, -0.5, 0.5, -0.5]}
    lens = {"camera_intrinsic": [[1266, 0, 800], [0, 1266, 450], [0, 0, 1]]}
    tables["calibrated_sensor"].append(
        {"token": "camera", "sensor_token": "camera", **pose, **lens}
    )
    for row in [row for row in tables["sample_data"] if row["is_key_frame"]]:
        new = {
            "token": f"{row['token']}-camera",
            "calibrated_sensor_token": "camera",
            "fileformat": "jpg",
        }
        new |= {
            "height": 900,
            "width": 1600,
            "filename": "samples/CAM_FRONT/none.jpg",
            "prev": "",
            "next": "",
        }
        tables["sample_data"].append(row | new)
    for name, rows in tables.items():
        (folder / f"{name}.json").write_text(json.dumps(rows))


def complete(file: Path, names: list[str]) -> None:
    """Add classes without objects to a GT database's list, which this script has just written."""
    found = pickle.loads(file.read_bytes())
    file.write_bytes(pickle.dumps({name: [] for name in names} | found))


if __name__ == "__main__":
    run(main)
