"""OpenPCDet's own ``train.py`` with its evaluation: PointPillars on KITTI, CenterPoint with voxels
on nuScenes."""

import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import yaml

from lidar_synth.formats import WRITERS
from lidar_synth.formats.convert import convert
from lidar_synth.lab.town import Town
from trainers.trial import NOT_PIP, PIP, Failed, Row, Trial

TITLE = "OpenPCDet 0.6"

PAGE = "openpcdet"
SCRIPTS = Path(__file__).parent / "scripts"
LEFT_OUT = (
    "its GPU kernels: non-maximum suppression is ours, from its overlaps for a CPU; `pointnet2`, "
    "RoI pooling"
)


def rows(trial: Trial) -> Iterator[Row]:
    """Two epochs and a resumed one on KITTI; two on nuScenes."""
    # to compile its functions for a CPU
    python = trial.environment("setuptools", "ninja")
    trial.type_page("install", python, PAGE, {}, skip=NOT_PIP)
    tree = trial.tree("OPENPCDET_ROOT")
    yield kitti(trial, python, tree)
    yield nuscenes(trial, python, tree)


def kitti(trial: Trial, python: Path, tree: Path) -> Row:
    """Stock PointPillars on cars, pedestrians and cyclists."""
    data = trial.folder / "kitti"
    shutil.copytree(trial.data.kitti, data)
    trial.run(
        "KITTI's lists",
        [
            python,
            SCRIPTS / "openpcdet_prepare.py",
            tree,
            "kitti",
            data,
            trial.data.objects,
        ],
    )
    mixture = {"synthetic": str(trial.data.bank), "ratio": 0.5}
    mixture |= {"labels": {"paste": {"bank": str(trial.data.objects)}}}

    def train(title: str, out: str) -> str:
        changes = f"DATA_CONFIG.DATA_PATH {data}"
        expect = [r"Loss: \d", r"Car AP_R40@0.70, 0.70, 0.70"]
        return type_training(
            trial, python, title, "MixedKitti", mixture, changes, out, expect
        )

    whole = train("PointPillars", "whole")
    first = next((trial.folder / "whole").rglob("checkpoint_epoch_1.pth"), None)
    if first is None:
        raise Failed("no checkpoint after the first epoch")
    half = len(batches(whole)) // 2
    folder = trial.folder / "resumed" / first.parent.relative_to(trial.folder / "whole")
    folder.mkdir(parents=True)
    shutil.copy(first, folder)
    rest = batches(train("PointPillars resumed", "resumed"))
    if rest != batches(whole)[half:]:
        raise Failed(f"the resumed run saw {rest} instead of {batches(whole)[half:]}")
    script = "openpcdet train.py --cfg_file cfgs/kitti_models/pointpillar.yaml"
    return trial.row(
        script, ["training", "validation", "checkpoint", "resume"], LEFT_OUT
    )


def nuscenes(trial: Trial, python: Path, tree: Path) -> Row:
    """Stock CenterPoint with voxels of 0.1 m; town scans of nuScenes' sensor are real and synthetic
    ones."""
    data = trial.folder / "nuscenes"
    trial.run("nuScenes", [python, SCRIPTS / "nuscenes_town.py", data / "v1.0-mini"])
    synthetic = trial.folder / "synthetic"
    convert(
        Town(seed=9, sensor="hdl32e_nuscenes", scans=4),
        WRITERS["npz"](synthetic),
        progress=False,
    )
    trial.run(
        "nuScenes' lists",
        [
            python,
            SCRIPTS / "openpcdet_prepare.py",
            tree,
            "nuscenes",
            data,
            trial.data.objects,
        ],
    )
    mixture = {"synthetic": str(synthetic), "ratio": 0.5}
    small = yaml.safe_load(
        (tree / "tools/cfgs/dataset_configs/nuscenes_dataset.yaml").read_text()
    )
    # It divides by the number of objects of each class; the town has four.
    small |= {"BALANCED_RESAMPLING": False}
    small["DATA_AUGMENTOR"]["AUG_CONFIG_LIST"][0]["SAMPLE_GROUPS"] = [
        "car:2",
        "pedestrian:2",
    ]
    (tree / "tools/cfgs/dataset_configs/nuscenes_dataset.yaml").write_text(
        yaml.safe_dump(small)
    )
    changes = f"DATA_CONFIG.DATA_PATH {data} DATA_CONFIG.VERSION v1.0-mini"
    expect = [r"Loss: \d", r"NDS: \d"]
    type_training(
        trial, python, "CenterPoint", "MixedNuScenes", mixture, changes, "nus", expect
    )
    if not list((trial.folder / "nus").rglob("checkpoint_epoch_1.pth")):
        raise Failed("no checkpoint")
    return trial.row(
        "openpcdet train.py --cfg_file cfgs/nuscenes_models/cbgs_voxel01_res3d_centerpoint.yaml",
        ["training", "validation", "checkpoint"],
        LEFT_OUT,
    )


def type_training(
    trial: Trial,
    python: Path,
    title: str,
    dataset: str,
    mixture: dict[str, object],
    changes: str,
    out: str,
    expect: list[str],
) -> str:
    """Type the page's command for one of its datasets, with the script for a CPU that the page
    names."""
    file = trial.folder / f"{dataset}.yaml"
    file.write_text(yaml.safe_dump(mixture))
    options = (
        "--epochs 2 --batch_size 2 --workers 1 --logger_iter_interval 1 --wo_gpu_stat"
    )
    names = {
        "OpenPCDet/tools": trial.folder / "tree" / "tools",
        "/data/mix.yaml": file,
        "-m lidar_synth.integrations.openpcdet": SCRIPTS / "openpcdet_cpu.py",
        "--cfg_file": f"{options} --cfg_file",
        dataset: f"{dataset} {changes}",
    }
    other = "MixedNuScenes" if dataset == "MixedKitti" else "MixedKitti"
    env = {"OPENPCDET_OUTPUT": str(trial.folder / out)}
    return trial.type_page(
        title,
        python,
        PAGE,
        names,
        skip=f"{PIP}|{other}",
        env=env,
        expect=expect,
        minutes=90,
    )


def batches(output: str) -> list[str]:
    """The names in each training batch of a run."""
    return re.findall(r"batch of (\[.*\])", output.partition("Start evaluation")[0])
