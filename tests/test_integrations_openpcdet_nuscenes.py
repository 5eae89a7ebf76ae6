# ruff: noqa: E402, NPY002 - imports wait for what they need; trainers draw from numpy's global
# generator
"""OpenPCDet's nuScenes dataset, info lists, GT database and ``train.py`` on mixed scans:
OPENPCDET_ROOT is a checkout.

The streets are the town's, seen by nuScenes' sensor and written in nuScenes' form; where
LIDAR_SYNTH_REAL_SCANS has a recorded key frame, it takes part.
"""

import os
import pickle
import re
import shutil
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from checkouts import SCRIPTS, checkout, needs, run_script

ROOT = checkout("OPENPCDET_ROOT", "OpenPCDet")
needs(
    "skimage",
    "SharedArray",
    "spconv",
    "pyquaternion",
    "nuscenes",
    "torchvision",
    "easydict",
)
sys.path.insert(0, str(SCRIPTS))
from openpcdet_cpu import prepare
from openpcdet_prepare import add_camera

prepare(ROOT)

import easydict
import torch
from layouts import write_all
from lidar_synth.integrations.nuscenes import NAMES, as_nuscenes
from lidar_synth.integrations.openpcdet import register
from nuscenes_town import write_dataset
from pcdet.datasets import __all__ as registered
from pcdet.datasets.nuscenes.nuscenes_dataset import (
    NuScenesDataset,
    create_nuscenes_info,
)
from pcdet.utils.common_utils import create_logger

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.formats import open_scans
from lidar_synth.geometry.scan import Boxes
from lidar_synth.lab.town import Town

VERSION = "v1.0-mini"
NAME = "MixedNuScenes"
SWEEPS = 10
CENTERPOINT = (
    ROOT / "tools" / "cfgs" / "nuscenes_models" / "cbgs_voxel01_res3d_centerpoint.yaml"
)
CLASSES = yaml.safe_load(CENTERPOINT.read_text())["CLASS_NAMES"]
TOWN = {"Car", "Van", "Truck", "Pedestrian", "Cyclist"}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """nuScenes' folder, its info lists and GT database by OpenPCDet's own code, and synthetic
    scans."""
    root = tmp_path_factory.mktemp("nuscenes")
    write_dataset(root / "nuscenes" / VERSION, seed=0)
    add_camera(root / "nuscenes" / VERSION / VERSION)
    create_nuscenes_info(VERSION, root / "nuscenes", root / "nuscenes", SWEEPS)
    add_recorded(root / "nuscenes" / VERSION)
    # It counts points on a GPU.
    torch.Tensor.cuda = lambda self, *args, **options: self  # type: ignore[method-assign]
    plain(root).create_groundtruth_database(max_sweeps=SWEEPS)
    town = Town(seed=7, sensor="hdl32e_nuscenes", scans=6)
    write_all("npz", root / "synthetic", [town[i] for i in range(6)])
    return root


def add_recorded(folder: Path) -> None:
    """Add nuScenes' recorded key frame, if there is one, to the training list; it has no sweeps and
    no boxes there."""
    given = os.environ.get("LIDAR_SYNTH_REAL_SCANS")
    for path in (
        sorted((Path(given) / "nuscenes/samples/LIDAR_TOP").glob("*.bin"))
        if given
        else ()
    ):
        shutil.copy(path, folder / "samples" / "LIDAR_TOP")
        file = folder / f"nuscenes_infos_{SWEEPS}sweeps_train.pkl"
        infos = pickle.loads(file.read_bytes())
        name = f"samples/LIDAR_TOP/{path.name}"
        sweep = {"lidar_path": name, "transform_matrix": None, "time_lag": 0}
        infos.append(
            infos[0]
            | {"lidar_path": name, "token": path.stem, "sweeps": [sweep] * (SWEEPS - 1)}
        )
        file.write_bytes(pickle.dumps(infos))


def config(
    made: Path, sweeps: int = SWEEPS, scans: str | Path = "synthetic", **settings: Any
) -> Any:
    """The stock data configuration for the tests' scans."""
    loaded = yaml.safe_load(
        (ROOT / "tools/cfgs/dataset_configs/nuscenes_dataset.yaml").read_text()
    )
    loaded |= {
        "DATA_PATH": str(made / "nuscenes"),
        "VERSION": VERSION,
        "MAX_SWEEPS": sweeps,
        "BALANCED_RESAMPLING": False,
    }
    sampling = loaded["DATA_AUGMENTOR"]["AUG_CONFIG_LIST"][0]
    sampling["SAMPLE_GROUPS"] = [
        "car:2",
        "pedestrian:2",
    ]  # the town has four of the ten classes
    loaded["LIDAR_SYNTH"] = {
        "SYNTHETIC": str(made / scans),
        "RATIO": 0.5,
        "SEED": 3,
        **settings,
    }
    return easydict.EasyDict(loaded)


def build(made: Path, **options: Any) -> Any:
    register()
    loaded = config(made, **options)
    return registered[NAME](
        loaded,
        CLASSES,
        training=True,
        root_path=made / "nuscenes",
        logger=create_logger(),
    )


def plain(made: Path, **options: Any) -> Any:
    """The trainer's own training set."""
    loaded = config(made, **options)
    loaded.DATA_AUGMENTOR.DISABLE_AUG_LIST = ["gt_sampling"]
    return NuScenesDataset(
        loaded,
        CLASSES,
        training=True,
        root_path=made / "nuscenes",
        logger=create_logger(),
    )


@pytest.fixture(autouse=True)
def complete_database(made: Path) -> None:
    """The stock sampler looks up all ten classes in the GT database."""
    file = made / "nuscenes" / VERSION / f"nuscenes_dbinfos_{SWEEPS}sweeps_withvelo.pkl"
    infos = pickle.loads(file.read_bytes())
    file.write_bytes(pickle.dumps({name: infos.get(name, []) for name in CLASSES}))


@pytest.mark.filterwarnings("ignore:MAX_SWEEPS")
def test_samples_have_the_form_of_the_trainers_own(made: Path) -> None:
    """Five features, ten sweeps, intensity up to 255, boxes with a velocity that is zero where it
    is unknown."""
    dataset = build(made)
    assert Counter(dataset.domain(i) for i in range(len(dataset))) == {
        0: len(dataset.infos),
        1: len(dataset.infos),
    }
    samples: dict[int, list[Any]] = {0: [], 1: []}
    np.random.seed(0)
    for position in range(len(dataset)):
        samples[dataset.domain(position)].append(dataset[position])
    for real, synthetic in zip(*samples.values(), strict=True):
        assert set(real) == set(synthetic)
        for key in ("points", "gt_boxes", "voxels", "voxel_coords"):
            assert (
                real[key].dtype == synthetic[key].dtype
                and real[key].shape[1:] == synthetic[key].shape[1:]
            ), key
        assert (
            synthetic["points"].shape[1] == 5
            and 100 < synthetic["points"][:, 3].max() <= 255
        )
        assert (
            synthetic["points"][:, 4] == 0
        ).mean() > 0.9  # pasted objects have the times of their sweeps
        assert np.isfinite(synthetic["gt_boxes"]).all()
        assert synthetic["voxel_num_points"].max() == 10 and str(
            synthetic["frame_id"]
        ).startswith("synthetic/")


@pytest.mark.filterwarnings("ignore:MAX_SWEEPS")
def test_real_samples_are_the_trainers_own(made: Path) -> None:
    ours = build(made)
    theirs = plain(made)
    theirs.data_augmentor = build(made).data_augmentor  # with GT sampling
    for position in (i for i in range(len(ours)) if not ours.domain(i)):
        np.random.seed(5)
        mine = ours[position]
        np.random.seed(5)
        own = theirs[ours.mixed[position]]
        assert all(
            np.array_equal(mine[key], own[key])
            for key in ("points", "gt_boxes", "voxels")
        )


def test_points_and_boxes_turn_together_into_nuscenes_frame(made: Path) -> None:
    dataset = build(made, sweeps=1)
    dataset.data_augmentor.data_augmentor_queue = []
    source = {
        f"synthetic/{scan.id}": as_nuscenes(scan)
        for scan in open_scans(made / "synthetic", sensor="hdl32e_nuscenes")
    }
    for position in (i for i in range(len(dataset)) if dataset.domain(i)):
        sample = dataset[position]
        scan = source[sample["frame_id"]]
        assert scan.boxes is not None
        near = (np.abs(scan.boxes.values[:, :2]) < 51.2).all(1)
        assert near.any() and len(sample["gt_boxes"]) == near.sum()
        boxes = Boxes(sample["gt_boxes"][:, :7], ("car",) * near.sum())
        inside = (np.abs(scan.points[:, :2]) < 51.2).all(1) & (
            np.abs(scan.points[:, 2] + 1) < 4
        )
        assert np.array_equal(
            boxes.contain(sample["points"][:, :3]).sum(1),
            scan.boxes[near].contain(scan.points[inside]).sum(1),
        )
        names = np.array(CLASSES)[sample["gt_boxes"][:, -1].astype(int) - 1]
        assert names.tolist() == np.array(scan.boxes.names)[near].tolist() and set(
            names
        ) <= {NAMES[n] for n in TOWN}


def test_sweeps_that_synthetic_scans_do_not_have_are_named(made: Path) -> None:
    with pytest.warns(
        UserWarning, match="MAX_SWEEPS: 10, but a synthetic scan has one sweep"
    ):
        build(made)


@pytest.mark.filterwarnings("ignore:MAX_SWEEPS")
def test_what_cannot_be_trained_on_is_refused_before(
    made: Path, tmp_path: Path
) -> None:
    from dataclasses import replace

    scans = list(open_scans(made / "synthetic", sensor="hdl32e_nuscenes"))
    write_all(
        "npz", tmp_path / "without", [replace(scan, boxes=None) for scan in scans]
    )
    with pytest.raises(DataError, match="has no boxes"):
        build(made, scans=tmp_path / "without")
    named = [
        replace(s, boxes=replace(s.boxes, names=("Lorry",) * len(s.boxes)))
        for s in scans
        if s.boxes
    ]
    write_all("npz", tmp_path / "named", named)
    with pytest.raises(DataError, match="boxes of .'Lorry'."):
        build(made, scans=tmp_path / "named")
    register()
    loaded = config(made)
    loaded.POINT_FEATURE_ENCODING.src_feature_list = ["x", "y", "z", "intensity"]
    with pytest.raises(ConfigError, match="'timestamp'"):
        registered[NAME](
            loaded,
            CLASSES,
            training=True,
            root_path=made / "nuscenes",
            logger=create_logger(),
        )


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_centerpoint_trains_and_is_evaluated_by_nuscenes_devkit(
    made: Path, tmp_path: Path
) -> None:
    """Stock CenterPoint with its sparse 3-D network and voxel head, only a coarser grid and fewer
    channels elsewhere.

    This does not show: OpenPCDet's GPU kernel of non-maximum suppression.
    """
    own = yaml.safe_load(CENTERPOINT.read_text())
    data = config(made)
    del data["LIDAR_SYNTH"]
    data["DATA_PROCESSOR"][2]["VOXEL_SIZE"] = [0.4, 0.4, 0.2]
    own["DATA_CONFIG"] = yaml.safe_load(yaml.safe_dump(plain_types(data)))
    own["MODEL"]["BACKBONE_2D"] |= {
        "LAYER_NUMS": [1, 1],
        "NUM_FILTERS": [16, 16],
        "NUM_UPSAMPLE_FILTERS": [16, 16],
    }
    (tmp_path / "small.yaml").write_text(yaml.safe_dump(own))
    mixture = {"synthetic": str(made / "synthetic"), "ratio": 0.5, "seed": 3}
    (tmp_path / "mix.yaml").write_text(yaml.safe_dump(mixture))
    said = run_script(
        SCRIPTS / "openpcdet_cpu.py",
        "train.py",
        "--cfg_file",
        str(tmp_path / "small.yaml"),
        "--epochs",
        "1",
        "--batch_size",
        "2",
        "--workers",
        "0",
        "--logger_iter_interval",
        "1",
        "--wo_gpu_stat",
        "--set",
        "DATA_CONFIG.DATASET",
        NAME,
        cwd=ROOT / "tools",
        mixture=tmp_path / "mix.yaml",
        OPENPCDET_OUTPUT=str(tmp_path),
    )
    before, _, after = said.partition("Start evaluation")
    names = [
        name
        for batch in re.findall(r"batch of (\[.*\])", before)
        for name in yaml.safe_load(batch)
    ]
    real = len(
        pickle.loads(
            (
                made / "nuscenes" / VERSION / f"nuscenes_infos_{SWEEPS}sweeps_train.pkl"
            ).read_bytes()
        )
    )
    assert Counter(name.startswith("synthetic/") for name in names) == {
        False: real,
        True: real,
    }
    losses = [float(value) for value in re.findall(r"Loss: (\S+) ", before)]
    assert len(losses) == real and np.isfinite(losses).all()
    assert re.search(r"mAP: [\d.]+", after) and re.search(r"NDS: [\d.]+", after)


def plain_types(value: Any) -> Any:
    """EasyDict and tuples as YAML writes them."""
    if isinstance(value, dict):
        return {key: plain_types(each) for key, each in value.items()}
    return (
        [plain_types(each) for each in value]
        if isinstance(value, list | tuple)
        else value
    )
