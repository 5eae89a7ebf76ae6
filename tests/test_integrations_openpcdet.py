# ruff: noqa: E402, NPY002 - imports wait for what they need; trainers draw from numpy's global generator
"""OpenPCDet's own dataset, augmentor and collate code on mixed scans: OPENPCDET_ROOT is a checkout, built or not."""

import importlib
import re
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from checkouts import checkout, launch, openpcdet_stand_ins

ROOT = checkout("OPENPCDET_ROOT", "OpenPCDet")
easydict = pytest.importorskip("easydict", reason="easydict is not installed")
pytest.importorskip("skimage", reason="scikit-image is not installed")
sys.path[:0] = [str(ROOT), str(ROOT / "tools")]
openpcdet_stand_ins()

import lidar_synth.integrations.openpcdet as adapter
import pcdet
import torch
from layouts import write_all
from lidar_synth.integrations.detection import in_view, write_gt_database
from lidar_synth.integrations.openpcdet import NAME, register
from pcdet.datasets import __all__ as registered
from pcdet.datasets.kitti import kitti_dataset
from pcdet.datasets.kitti.kitti_dataset import KittiDataset, create_kitti_infos
from streets import held, kitti, street, synthetic
from torch.utils.data import DataLoader

from lidar_synth.errors import ConfigError, DataError, LibraryError
from lidar_synth.formats import open_scans
from lidar_synth.geometry.scan import Boxes
from lidar_synth.labels import ObjectBank

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


def build(made: Path, scans: str | Path = "synthetic", kitti: str = "kitti", **options: Any) -> Any:
    register()
    loaded = config(made / kitti, made / scans, **options)
    return registered[NAME](loaded, CLASSES, training=True, root_path=made / kitti)


def both(made: Path) -> tuple[Any, Any]:
    """The trainer's own training set and ours, of the same real scans; tools/bench/trainers.py times them."""
    loaded = config(made / "kitti", made / "synthetic")
    return KittiDataset(loaded, CLASSES, training=True, root_path=made / "kitti"), build(made)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make(tmp_path_factory.mktemp("openpcdet"))


def make(root: Path) -> Path:
    """KITTI's folders, their info lists and GT database by OpenPCDet's own code, and synthetic scans."""
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
    theirs, ours = both(made)
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


def test_gt_sampling_places_objects_on_the_synthetic_ground(made: Path) -> None:
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


def test_invalid_settings_are_refused(made: Path) -> None:
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
    with pytest.raises(ConfigError, match="planes without 1 scans .000003.*write_planes"):
        registered[NAME](loaded, CLASSES, training=True, root_path=made / "kitti")
    plane.with_suffix(".gone").rename(plane)
    del loaded["LIDAR_SYNTH"]
    with pytest.raises(ConfigError, match="LIDAR_SYNTH_MIX=mix.yaml"):
        registered[NAME](loaded, CLASSES, training=True, root_path=made / "kitti")


@pytest.mark.parametrize("version", ["0.5.2", "1.0.0"])
def test_other_versions_are_refused(version: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pcdet, "__version__", version)
    monkeypatch.delitem(sys.modules, adapter.__name__)
    with pytest.raises(LibraryError, match=f"OpenPCDet {version}"):
        importlib.import_module(adapter.__name__)


def test_synthetic_scans_that_cannot_be_trained_on_are_refused_before(made: Path, tmp_path: Path) -> None:
    scans = [street(i) for i in range(4)]
    write_all("npz", tmp_path / "without", [replace(scan, boxes=None) for scan in scans])
    boxes = [scan.boxes for scan in scans]
    renamed = [replace(s, boxes=replace(b, names=("car",) * 3)) for s, b in zip(scans, boxes, strict=True) if b]
    write_all("npz", tmp_path / "named", renamed)
    build(made, tmp_path / "without")
    with pytest.raises(DataError, match="has no boxes, and there is no gt_sampling"):
        build(made, tmp_path / "without", sampling=False)
    with pytest.raises(DataError, match="boxes of .'car'. in synthetic scan .* some of Car"):
        build(made, tmp_path / "named")
    calib = made / "kitti" / "training" / "calib" / "000002.txt"
    calib.rename(calib.with_suffix(".gone"))
    with pytest.raises(ConfigError, match="calib without 1 scans .000002"):
        build(made)
    calib.with_suffix(".gone").rename(calib)


def test_the_training_loop_tells_the_epoch(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_its_own_script_trains_from_our_launcher(made: Path, tmp_path: Path) -> None:
    """Stock PointPillars, only smaller: ``train.py`` as a user types it, two epochs with two workers."""
    tools = ROOT / "tools"
    own = yaml.safe_load((tools / "cfgs/kitti_models/pointpillar.yaml").read_text())
    data, model = own["DATA_CONFIG"], own["MODEL"]
    data |= {"DATA_PATH": str(made / "kitti"), "POINT_CLOUD_RANGE": [0, -12.8, -3, 25.6, 12.8, 1]}
    data["DATA_PROCESSOR"][2]["VOXEL_SIZE"] = [0.4, 0.4, 4]
    sampling = data["DATA_AUGMENTOR"]["AUG_CONFIG_LIST"][0]
    sampling |= {"SAMPLE_GROUPS": ["Car:3"], "PREPARE": {"filter_by_min_points": ["Car:5"]}}
    own["CLASS_NAMES"] = CLASSES
    del model["DENSE_HEAD"]["ANCHOR_GENERATOR_CONFIG"][1:]
    model["BACKBONE_2D"] |= {"NUM_FILTERS": [16, 16, 16], "NUM_UPSAMPLE_FILTERS": [16, 16, 16]}
    (tmp_path / "small.yaml").write_text(yaml.safe_dump(own))
    mixture = {"synthetic": str(made / "synthetic"), "ratio": 0.4, "seed": 3}
    (tmp_path / "mix.yaml").write_text(yaml.safe_dump(mixture))
    said = launch(
        "openpcdet", "train.py", "--cfg_file", str(tmp_path / "small.yaml"), "--epochs", "2", "--batch_size", "2",
        "--workers", "2", "--fix_random_seed", "--logger_iter_interval", "1", "--wo_gpu_stat",
        "--set", "DATA_CONFIG.DATASET", NAME,
        cwd=tools, mixture=tmp_path / "mix.yaml",
    )  # fmt: skip
    losses = [float(value) for value in re.findall(r"Loss: (\S+) ", said)]
    batches = [yaml.safe_load(batch) for batch in re.findall(r"batch of (.*)", said)]
    each = (REAL + EXTRA) // 2
    assert len(losses) == len(batches) == 2 * each and np.isfinite(losses).all()
    for epoch in (batches[:each], batches[each:]):
        assert sum(map(Counter, epoch), Counter()) == {"real": REAL, "synthetic": EXTRA}
    assert list(tmp_path.rglob("checkpoint_epoch_2.pth"))
