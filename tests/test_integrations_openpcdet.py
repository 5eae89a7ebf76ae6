# ruff: noqa: E402, NPY002 - imports wait for what they need; trainers draw from numpy's global generator
"""OpenPCDet's own dataset, augmentor and collate code on mixed scans: OPENPCDET_ROOT is a checkout, built or not."""

import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from checkouts import checkout, overlaps, points_in_boxes, stand_in

ROOT = checkout("OPENPCDET_ROOT", "OpenPCDet")
easydict = pytest.importorskip("easydict", reason="easydict is not installed")
pytest.importorskip("skimage", reason="scikit-image is not installed")
sys.path[:0] = [str(ROOT), str(ROOT / "tools")]
stand_in("SharedArray")
stand_in("torchvision")
stand_in("pcdet.version", __version__="0.6.0")
for name in ("nuscenes.nuscenes", "waymo.waymo", "pandaset.pandaset", "lyft.lyft", "once.once", "argo2.argo2"):
    sys.modules[f"pcdet.datasets.{name}_dataset"] = stand_in(f"stands_for_{name.rpartition('.')[2]}")
stand_in("pcdet.ops.iou3d_nms.iou3d_nms_cuda", boxes_iou_bev_cpu=overlaps)
stand_in("pcdet.ops.roiaware_pool3d.roiaware_pool3d_cuda", points_in_boxes_cpu=points_in_boxes)

import torch
from lidar_synth.integrations.detection import in_view, write_gt_database
from lidar_synth.integrations.openpcdet import NAME, register
from pcdet.datasets import __all__ as registered
from pcdet.datasets.kitti import kitti_dataset
from pcdet.datasets.kitti.kitti_dataset import KittiDataset, create_kitti_infos
from streets import held, kitti, synthetic
from torch.utils.data import DataLoader

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.formats import open_scans
from lidar_synth.labels import ObjectBank
from lidar_synth.scan import Boxes

REAL, EXTRA, CLASSES = 6, 4, ["Car"]


def config(root: Path, synthetic_scans: Path, sampling: bool = True, **settings: Any) -> Any:
    """The stock data configuration, without its last step (spconv's voxels), for the tests' scans."""
    loaded = yaml.safe_load((ROOT / "tools/cfgs/dataset_configs/kitti_dataset.yaml").read_text())
    loaded["DATA_PROCESSOR"] = loaded["DATA_PROCESSOR"][:2]
    loaded["DATA_PATH"] = str(root)
    loaded["LIDAR_SYNTH"] = {"SYNTHETIC": str(synthetic_scans), "RATIO": 0.4, "SEED": 3, **settings}
    augment = loaded["DATA_AUGMENTOR"]["AUG_CONFIG_LIST"]
    augment[0] |= {"SAMPLE_GROUPS": ["Car:3"], "PREPARE": {"filter_by_min_points": ["Car:5"]}}
    if not sampling:
        loaded["DATA_AUGMENTOR"]["DISABLE_AUG_LIST"] = ["gt_sampling"]
    return easydict.EasyDict(loaded)


def build(made: Path, scans: str = "synthetic", kitti: str = "kitti", **options: Any) -> Any:
    register()
    loaded = config(made / kitti, made / scans, **options)
    return registered[NAME](loaded, CLASSES, training=True, root_path=made / kitti)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """KITTI's folders, their info lists and GT database by OpenPCDet's own code, and synthetic scans."""
    root = tmp_path_factory.mktemp("openpcdet")
    synthetic(root / "synthetic", 11)
    synthetic(root / "bare", 5, boxes=False)
    kitti(root / "kitti", REAL)
    write_infos(root / "kitti")
    return root


def write_infos(root: Path) -> None:
    import pickle

    kitti_dataset.Path = Path  # it imports that only when it is run as a script
    (root / "ImageSets" / "val.txt").write_text("")
    loaded = config(root, root)
    dataset = KittiDataset(loaded, CLASSES, training=False, root_path=root)
    dataset.set_split("train")
    with (root / "kitti_infos_train.pkl").open("wb") as file:
        pickle.dump(dataset.get_infos(num_workers=1), file)
    dataset.create_groundtruth_database(root / "kitti_infos_train.pkl", split="train")


def is_synthetic(name: Any) -> bool:
    return str(name).startswith("synthetic/")


def test_the_class_is_registered_beside_the_trainers_own(made: Path) -> None:
    register()
    assert issubclass(registered[NAME], KittiDataset) and create_kitti_infos is not None


@pytest.mark.parametrize("workers", [0, 2])
def test_two_epochs_see_exactly_the_planned_scans(made: Path, workers: int) -> None:
    dataset = build(made)
    loader = DataLoader(dataset, batch_size=2, shuffle=True, num_workers=workers, collate_fn=dataset.collate_batch)
    numbers = {f"synthetic/{scan.id}": i for i, scan in enumerate(open_scans(made / "synthetic"))}
    seen = []
    for epoch in (0, 1):
        dataset.set_epoch(epoch)
        names = [name for batch in loader for name in batch["frame_id"]]
        assert Counter(map(is_synthetic, names)) == {False: REAL, True: EXTRA}
        assert sorted(n for n in names if not is_synthetic(n)) == [f"{i:06d}" for i in range(REAL)]
        made_plan = dataset.mixed.plan()
        assert {numbers[n] for n in names if is_synthetic(n)} == set(made_plan.index[made_plan.domain].tolist())
        seen.append({n for n in names if is_synthetic(n)})
    assert not seen[0] & seen[1]


def test_real_samples_are_the_trainers_own(made: Path) -> None:
    ours, loaded = build(made), config(made / "kitti", made / "synthetic")
    theirs = KittiDataset(loaded, CLASSES, training=True, root_path=made / "kitti")
    positions = [i for i in range(len(ours)) if not ours.domain(i)]
    for position in positions:
        index = ours.mixed[position]
        np.random.seed(5)  # OpenPCDet draws from it
        mine = ours[position]
        np.random.seed(5)
        # GT sampling goes on through its database from sample to sample.
        own = theirs[index]
        assert set(mine) == set(own)
        for key in ("points", "gt_boxes"):
            assert mine[key].dtype == own[key].dtype and np.array_equal(mine[key], own[key])


def test_boxes_hold_their_points_after_augmentation(made: Path) -> None:
    dataset = build(made)
    source = {f"synthetic/{scan.id}": scan for scan in open_scans(made / "synthetic")}
    np.random.seed(0)  # OpenPCDet draws from it
    for position in range(len(dataset)):
        sample = dataset[position]
        boxes = Boxes(sample["gt_boxes"][:, :7], ("Car",) * len(sample["gt_boxes"]))
        counts = held(boxes, sample["points"][:, :3])
        assert (sample["gt_boxes"][:, 7] == 1).all() and counts.min() >= 5
        if dataset.domain(position):
            scan = in_view(source[sample["frame_id"]], dataset._view[1])
            assert scan.boxes is not None
            before = held(scan.boxes, scan.points)
            assert len(counts) >= 2 and np.abs(counts[:2] - before).max() <= 3  # those on a face


def test_gt_sampling_stands_on_the_synthetic_ground(made: Path) -> None:
    """The stock setting wants a plane and a calibration, which a synthetic scan has to bring."""
    dataset = build(made, "bare")
    np.random.seed(1)  # OpenPCDet draws from it
    for position in (i for i in range(len(dataset)) if dataset.domain(i)):
        sample = dataset[position]
        floor = sample["gt_boxes"][:, 2] - sample["gt_boxes"][:, 5] / 2
        scale = np.linalg.norm(sample["lidar_aug_matrix"][:3, 0])
        assert len(floor) and np.abs(floor / scale + 1.73).max() < 0.1


def test_synthetic_scans_without_boxes_are_refused_not_replaced(made: Path) -> None:
    """Trap: OpenPCDet puts another scan in their place, and the mixture becomes all real."""
    dataset = build(made, "bare", sampling=False)
    np.random.seed(0)
    for position in range(len(dataset)):
        if dataset.domain(position):
            with pytest.raises(DataError, match="synthetic scan '.*' has no box .*labels: mix"):
                dataset[position]
        else:
            assert not is_synthetic(dataset[position]["frame_id"])


def test_real_scans_without_boxes_are_replaced_by_real_ones(made: Path) -> None:
    dataset = build(made, sampling=False)
    inner = dataset.kitti_infos[2]["annos"]
    for key in inner:
        inner[key] = inner[key][:0]
    for seed in range(8):
        np.random.seed(seed)  # OpenPCDet draws the other scan from it
        names = [dataset[i]["frame_id"] for i in range(len(dataset))]
        assert Counter(map(is_synthetic, names)) == {False: REAL, True: EXTRA} and "000002" not in names


def test_the_trainers_generator_does_not_decide_on_scans(made: Path) -> None:
    """Trap: OpenPCDet seeds its workers the same in every epoch."""
    dataset, orders = build(made), []
    for epoch in (0, 1):
        dataset.set_epoch(epoch)
        np.random.seed(666)
        orders.append([dataset[i]["frame_id"] for i in range(len(dataset)) if dataset.domain(i)])
    assert not set(orders[0]) & set(orders[1])


def test_a_database_of_any_source_is_drawn_from(made: Path, tmp_path: Path) -> None:
    root = kitti(tmp_path / "kitti", REAL)
    write_infos(root)
    objects = ObjectBank.from_scans(open_scans(made / "synthetic"))
    write_gt_database(objects, root, origin="gravity", folder="gt_town", infos="kitti_dbinfos_train.pkl")
    register()
    loaded = config(root, made / "bare")
    loaded.DATA_AUGMENTOR.AUG_CONFIG_LIST[0].PREPARE["filter_by_difficulty"] = [-1]
    dataset = registered[NAME](loaded, CLASSES, training=True, root_path=root)
    sampler = dataset.data_augmentor.data_augmentor_queue[0]
    assert {info["path"].split("/")[0] for info in sampler.db_infos["Car"]} == {"gt_town"}
    np.random.seed(3)
    for position in (i for i in range(len(dataset)) if dataset.domain(i)):
        sample = dataset[position]
        boxes = Boxes(sample["gt_boxes"][:, :7], ("Car",) * len(sample["gt_boxes"]))
        assert held(boxes, sample["points"][:, :3]).min() >= 5


def test_what_cannot_be_mixed_is_refused(made: Path) -> None:
    dataset = build(made)
    with pytest.raises(ConfigError, match="epochs one by one"):
        dataset.merge_all_iters_to_one_epoch(True, 3)
    loaded = config(made / "kitti", made / "synthetic")
    loaded.GET_ITEM_LIST = ["points", "images"]
    with pytest.raises(ConfigError, match="there is no picture"):
        registered[NAME](loaded, CLASSES, training=True, root_path=made / "kitti")
    loaded.GET_ITEM_LIST = ["points"]
    plane = made / "kitti" / "training" / "planes" / "000003.txt"
    plane.rename(plane.with_suffix(".gone"))
    with pytest.raises(ConfigError, match="no plane for 1 scans .000003.*write_planes"):
        registered[NAME](loaded, CLASSES, training=True, root_path=made / "kitti")
    plane.with_suffix(".gone").rename(plane)
    del loaded["LIDAR_SYNTH"]
    with pytest.raises(ConfigError, match="LIDAR_SYNTH_MIX=mix.yaml"):
        registered[NAME](loaded, CLASSES, training=True, root_path=made / "kitti")


def test_the_training_loop_tells_the_epoch(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in("kornia")
    from lidar_synth.integrations.openpcdet import tell_epochs
    from train_utils import train_utils as loop

    told: list[int] = []
    monkeypatch.setattr(loop, "train_one_epoch", lambda *args, **options: told.append(args[2].dataset.mixed.epoch))
    tell_epochs()
    dataset = build(made)
    loader = DataLoader(dataset, batch_size=2, collate_fn=dataset.collate_batch)
    monkeypatch.setattr(loop, "disable_augmentation_hook", lambda *args: False)
    monkeypatch.setattr(loop, "save_checkpoint", lambda *args, **options: None)
    monkeypatch.setattr(loop, "checkpoint_state", lambda *args: {})
    loop.train_model(
        torch.nn.Linear(1, 1), None, loader, None, None, easydict.EasyDict(), 3, 5, 0, 0, None, made, cfg={}
    )
    assert told == [3, 4]
