"""OpenPCDet's own ``train.py`` with its evaluation: PointPillars on KITTI, CenterPoint with voxels on nuScenes."""

import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import yaml

from lidar_synth.formats import WRITERS
from lidar_synth.formats.convert import convert
from lidar_synth.lab.town import Town
from trainers.trial import Failed, Row, Trial

TITLE = "OpenPCDet 0.6"

SCRIPTS = Path(__file__).parent / "scripts"
PACKAGES = (
    "SharedArray", "easydict", "scikit-image", "tensorboardX", "pyquaternion", "spconv", "torchvision", "setuptools",
    "ninja", "opencv-python-headless", "pandas", "pyarrow",
)  # fmt: skip
DEVKIT = ("cachetools", "descartes", "shapely", "scikit-learn", "matplotlib")  # nuscenes-devkit itself pins numpy < 2
LEFT_OUT = "its GPU kernels: non-maximum suppression is ours, from its overlaps for a CPU; `pointnet2`, RoI pooling"


def rows(trial: Trial) -> Iterator[Row]:
    """Two epochs and a resumed one on KITTI; two on nuScenes."""
    python = trial.environment(*PACKAGES)
    trial.install(python, *DEVKIT)
    trial.install(python, "nuscenes-devkit==1.2.0", options=["--no-deps"])
    tree = trial.tree("OPENPCDET_ROOT")
    yield kitti(trial, python, tree)
    yield nuscenes(trial, python, tree)


def kitti(trial: Trial, python: Path, tree: Path) -> Row:
    """Stock PointPillars on cars, pedestrians and cyclists."""
    data = trial.folder / "kitti"
    shutil.copytree(trial.data.kitti, data)
    trial.run("KITTI's lists", [python, SCRIPTS / "openpcdet_prepare.py", tree, "kitti", data, trial.data.objects])
    mixture = {"synthetic": str(trial.data.bank), "ratio": 0.5, "labels": "mix"}
    mixture |= {"label_options": {"objects": str(trial.data.objects)}}
    config = "cfgs/kitti_models/pointpillar.yaml"
    command, environment = train(trial, python, config, "MixedKitti", mixture, ["DATA_CONFIG.DATA_PATH", str(data)])
    environment |= {"OPENPCDET_OUTPUT": str(trial.folder / "whole")}
    whole = trial.run(
        "PointPillars", command, cwd=tree / "tools", env=environment, minutes=60,
        expect=[r"Loss: \d", r"Car AP_R40@0.70, 0.70, 0.70"],
    )  # fmt: skip
    first = next((trial.folder / "whole").rglob("checkpoint_epoch_1.pth"), None)
    if first is None:
        raise Failed("no checkpoint after the first epoch")
    half = len(batches(whole)) // 2
    folder = trial.folder / "resumed" / first.parent.relative_to(trial.folder / "whole")
    folder.mkdir(parents=True)
    shutil.copy(first, folder)
    environment |= {"OPENPCDET_OUTPUT": str(trial.folder / "resumed")}
    rest = batches(trial.run("PointPillars resumed", command, cwd=tree / "tools", env=environment, minutes=60))
    if rest != batches(whole)[half:]:
        raise Failed(f"the resumed run saw {rest} instead of {batches(whole)[half:]}")
    return trial.row(f"train.py --cfg_file {config}", ["training", "validation", "checkpoint", "resume"], LEFT_OUT)


def nuscenes(trial: Trial, python: Path, tree: Path) -> Row:
    """Stock CenterPoint with voxels of 0.1 m; town scans of nuScenes' sensor are real and synthetic ones."""
    data = trial.folder / "nuscenes"
    trial.run("nuScenes", [python, SCRIPTS / "nuscenes_town.py", data / "v1.0-mini"])
    synthetic = trial.folder / "synthetic"
    convert(Town(seed=9, sensor="hdl32e_nuscenes", scans=4), WRITERS["npz"](synthetic), progress=False)
    trial.run("nuScenes' lists", [python, SCRIPTS / "openpcdet_prepare.py", tree, "nuscenes", data, trial.data.objects])
    mixture = {"synthetic": str(synthetic), "ratio": 0.5}
    config = "cfgs/nuscenes_models/cbgs_voxel01_res3d_centerpoint.yaml"
    small = yaml.safe_load((tree / "tools/cfgs/dataset_configs/nuscenes_dataset.yaml").read_text())
    small |= {"BALANCED_RESAMPLING": False}  # it divides by the number of objects of each class; the town has four
    small["DATA_AUGMENTOR"]["AUG_CONFIG_LIST"][0]["SAMPLE_GROUPS"] = ["car:2", "pedestrian:2"]
    (tree / "tools/cfgs/dataset_configs/nuscenes_dataset.yaml").write_text(yaml.safe_dump(small))
    changes = ["DATA_CONFIG.DATA_PATH", str(data), "DATA_CONFIG.VERSION", "v1.0-mini"]
    command, environment = train(trial, python, config, "MixedNuScenes", mixture, changes)
    trial.run(
        "CenterPoint", command, cwd=tree / "tools", env=environment | {"OPENPCDET_OUTPUT": str(trial.folder / "nus")},
        expect=[r"Loss: \d", r"NDS: \d"], minutes=90,
    )  # fmt: skip
    if not list((trial.folder / "nus").rglob("checkpoint_epoch_1.pth")):
        raise Failed("no checkpoint")
    return trial.row(f"train.py --cfg_file {config}", ["training", "validation", "checkpoint"], LEFT_OUT)


def train(
    trial: Trial, python: Path, config: str, dataset: str, mixture: dict[str, object], changes: list[str],
) -> tuple[list[object], dict[str, str]]:  # fmt: skip
    """The command and its environment."""
    file = trial.folder / f"{dataset}.yaml"
    file.write_text(yaml.safe_dump(mixture))
    options = ["--epochs", 2, "--batch_size", 2, "--workers", 1, "--logger_iter_interval", 1, "--wo_gpu_stat"]
    changed = ["--set", "DATA_CONFIG.DATASET", dataset, *changes]
    command = [python, SCRIPTS / "openpcdet_cpu.py", "train.py", "--cfg_file", config, *options, *changed]
    return command, {"LIDAR_SYNTH_MIX": str(file)}


def batches(output: str) -> list[str]:
    """The names in each training batch of a run."""
    return re.findall(r"batch of (\[.*\])", output.partition("Start evaluation")[0])
