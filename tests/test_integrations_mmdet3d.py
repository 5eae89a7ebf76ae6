# ruff: noqa: E402, NPY002 - imports wait for what they need; trainers draw from numpy's global
# generator
"""MMDetection3D's own datasets, transforms and loaders on mixed lists; skipped where it is not
installed."""

import importlib
import os
import re
import runpy
import shutil
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip(
    "mmengine", reason="mmengine is not installed: bash tools/install_mmdet3d.sh"
)
pytest.importorskip(
    "mmcv", reason="mmcv is not installed: bash tools/install_mmdet3d.sh"
)
import mmcv_ext

mmcv_ext.install()
pytest.importorskip(
    "mmdet3d", reason="mmdet3d is not installed: bash tools/install_mmdet3d.sh"
)

import lidar_synth.integrations.mmdet3d as adapter
import mmdet3d
import torch
from layouts import write_all
from lidar_synth.integrations.detection import write_gt_database
from lidar_synth.integrations.mmdet3d_infos import write_infos
from lidar_synth.integrations.mmdet3d_lists import kitti_list, semantic_kitti_list
from lidar_synth.integrations.mmdet3d_slots import SlotFolder, open_folder, read_url
from mmdet3d.registry import DATASETS, TRANSFORMS
from mmdet3d_parts import CONFIGS, DATA_KEYS, bare, flat
from mmengine.config import Config
from mmengine.dataset import ClassBalancedDataset, pseudo_collate
from mmengine.fileio import get
from mmengine.registry import init_default_scope
from streets import CAMERA, held, kitti, semantic_kitti, street, synthetic
from torch.utils.data import DataLoader

from lidar_synth.datasets.classes import IGNORE
from lidar_synth.errors import ConfigError, DataError, LibraryError
from lidar_synth.formats import open_scans
from lidar_synth.formats.calibration import in_view
from lidar_synth.geometry.scan import Boxes, Scan
from lidar_synth.lab.start.trainers import DEFAULTS, configure, write_files
from lidar_synth.labels import ObjectBank

REAL = 6
EXTRA = 4
SYNTHETIC = 11
"""Real scans, synthetic samples of an epoch, synthetic scans that there are."""
MIX = {"ratio": 0.4, "seed": 3}
DETECTION = "pointpillars_kitti.py"


@pytest.fixture(autouse=True, scope="module")
def scope() -> None:
    init_default_scope("mmdet3d")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Real and synthetic scans, a GT database, and mixed lists for both tasks."""
    root = tmp_path_factory.mktemp("mmdet3d")
    settings = MIX | {"synthetic": synthetic(root / "synthetic", SYNTHETIC)}
    semantic_kitti_list(semantic_kitti(root / "sk", REAL), root / "sk" / "train.json")
    write_infos(
        root / "seg", root / "sk" / "train.json", settings, data_root=root / "sk"
    )
    kitti_list(kitti(root / "kitti", REAL), root / "kitti" / "train.json")
    write_infos(
        root / "det",
        root / "kitti" / "train.json",
        settings,
        data_root=root / "kitti",
        points="training/velodyne_reduced",
    )
    objects = ObjectBank.from_scans(open_scans(root / "synthetic"))
    write_gt_database(
        objects,
        root / "kitti",
        origin="bottom",
        folder="kitti_gt_database",
        infos="dbinfos.pkl",
    )
    return root


def train_set(config: str) -> dict[str, Any]:
    """The training dataset of one of our configurations, without what repeats it."""
    loaded = Config.fromfile(str(CONFIGS / config)).train_dataloader.dataset
    return loaded.get("dataset", loaded).to_dict()  # type: ignore[no-any-return]


def segmentation(
    made: Path, pipeline: list[dict[str, Any]] | None = None, **options: Any
) -> Any:
    loaded = (
        train_set("minkunet_semantickitti.py")
        | {"ann_file": str(made / "seg" / "infos.json")}
        | options
    )
    if pipeline is not None:
        loaded["pipeline"] = loaded["pipeline"][:3] + pipeline
    return DATASETS.build(loaded)


def detection(
    made: Path, pipeline: list[dict[str, Any]] | None = None, **options: Any
) -> Any:
    loaded = (
        train_set(DETECTION) | {"ann_file": str(made / "det" / "infos.json")} | options
    )
    for step in loaded["pipeline"]:
        if step["type"] == "ObjectSample":
            step["db_sampler"] |= {
                "data_root": str(made / "kitti"),
                "info_path": str(made / "kitti" / "dbinfos.pkl"),
                "classes": ["Car"],
                "sample_groups": {"Car": 5},
                "prepare": {
                    "filter_by_difficulty": [-1],
                    "filter_by_min_points": {"Car": 5},
                },
            }
    if pipeline is not None:
        loaded["pipeline"] = loaded["pipeline"][:2] + pipeline
    return DATASETS.build(loaded)


PACK = {
    "type": "Pack3DDetInputs",
    "keys": ["points", "pts_semantic_mask"],
    "meta_keys": ["lidar_path"],
}
PACK_BOXES = {
    "type": "Pack3DDetInputs",
    "keys": ["points", "gt_labels_3d", "gt_bboxes_3d"],
    "meta_keys": ["lidar_path"],
}


def is_synthetic(sample: Any) -> bool:
    return str(sample.lidar_path).startswith("lsynth://")


@pytest.mark.parametrize("make", [segmentation, detection])
def test_two_epochs_see_exactly_the_planned_scans(made: Path, make: Any) -> None:
    """Through a loader with persistent workers, which keep what they have read of the folder."""
    packed = PACK if make is segmentation else PACK_BOXES
    dataset = make(made, [packed])
    folder = open_folder(made / ("seg" if make is segmentation else "det"))
    sampler = adapter.SynthSampler(dataset)
    loader = DataLoader(
        dataset,
        batch_size=2,
        num_workers=2,
        sampler=sampler,
        persistent_workers=True,
        collate_fn=pseudo_collate,
    )
    source = open_scans(made / "synthetic")
    ids = {
        scan.reflectance[:50].tobytes() if make is segmentation else i: i
        for i, scan in enumerate(source)
    }
    seen: list[set[int]] = []
    for epoch in (0, 1):
        sampler.set_epoch(epoch)
        samples = [
            s
            for batch in loader
            for s in zip(batch["data_samples"], batch["inputs"]["points"], strict=True)
        ]
        assert Counter(is_synthetic(s) for s, _ in samples) == {
            False: REAL,
            True: EXTRA,
        }
        planned = folder.mixed.plan(epoch)
        wanted = set(planned.index[planned.domain].tolist())
        if make is segmentation:
            given = {
                ids[p[:50, 3].numpy().tobytes()] for s, p in samples if is_synthetic(s)
            }
            assert given == wanted
        seen.append(wanted)
    assert not seen[0] & seen[1]


def test_a_loader_without_the_sampler_is_refused(made: Path) -> None:
    """Its workers would read the synthetic scans of the first epoch in every epoch."""
    loader = DataLoader(
        segmentation(made, [PACK]), num_workers=1, collate_fn=pseudo_collate
    )
    with pytest.raises(
        ConfigError, match="type='SynthSampler'.*every epoch would have"
    ):
        list(loader)


def test_real_samples_are_the_trainers_own(made: Path) -> None:
    stock = train_set("minkunet_semantickitti.py") | {
        "ann_file": str(made / "sk" / "train.json"),
        "data_root": str(made / "sk"),
    }
    stock["pipeline"] = [*stock["pipeline"][:3], PACK]
    ours = segmentation(made, [PACK])
    theirs = DATASETS.build(stock)
    for i in range(REAL):
        assert torch.equal(ours[i]["inputs"]["points"], theirs[i]["inputs"]["points"])
        mine, own = (
            d[i]["data_samples"].gt_pts_seg.pts_semantic_mask for d in (ours, theirs)
        )
        assert np.array_equal(mine, own)


def test_real_boxes_are_the_trainers_own(made: Path) -> None:
    stock = train_set(DETECTION) | {
        "type": "KittiDataset",
        "ann_file": str(made / "kitti" / "train.json"),
        "data_root": str(made / "kitti"),
        "data_prefix": {"pts": "training/velodyne_reduced"},
    }
    stock["pipeline"] = [*stock["pipeline"][:2], PACK_BOXES]
    ours = detection(made, [PACK_BOXES])
    theirs = DATASETS.build(stock)
    for i in range(REAL):
        assert torch.equal(ours[i]["inputs"]["points"], theirs[i]["inputs"]["points"])
        boxes = [
            d[i]["data_samples"].gt_instances_3d.bboxes_3d.tensor
            for d in (ours, theirs)
        ]
        assert torch.equal(*boxes) and len(boxes[0]) == 2


def test_labels_arrive_in_the_trainers_ids(made: Path) -> None:
    dataset = segmentation(made, [PACK])
    folder = open_folder(made / "seg")
    for slot in range(EXTRA):
        sample = dataset[REAL + slot]
        scan = folder.scan(slot)
        points = sample["inputs"]["points"]
        mask = sample["data_samples"].gt_pts_seg.pts_semantic_mask
        assert np.array_equal(points, np.c_[scan.points, scan.reflectance])
        expected = np.where(scan.label == IGNORE, 19, scan.label)  # type: ignore[arg-type]
        assert np.array_equal(mask, expected)


def inside(sample: Any) -> list[int]:
    """Points in each box after the trainer's transforms; its boxes are ours, by their corners."""
    boxes = sample["data_samples"].gt_instances_3d.bboxes_3d
    ours = Boxes(
        np.c_[boxes.gravity_center, boxes.dims, boxes.yaw], ("Car",) * len(boxes)
    )
    assert np.allclose(np.sort(boxes.corners, 1), np.sort(ours.corners(), 1), atol=1e-4)
    return [int(c) for c in held(ours, sample["inputs"]["points"][:, :3].numpy())]


def test_boxes_hold_their_points_after_the_trainers_transforms(made: Path) -> None:
    """Flip, turn, scale and range filters of stock PointPillars."""
    torch.manual_seed(0)
    np.random.seed(0)  # the trainer's own generators
    steps = train_set(DETECTION)["pipeline"]
    dataset = detection(made, steps[3:])
    folder = open_folder(made / "det")
    for slot in range(EXTRA):
        scan = folder.scan(slot)
        # the third stands behind the camera
        assert scan.boxes is not None and len(scan.boxes) == 2
        sample = dataset[REAL + slot]
        counts = inside(sample)
        before = held(scan.boxes, scan.points)
        # those on a face
        assert before.min() >= 10 and np.abs(counts - before).max() <= 3
        assert sample["data_samples"].gt_instances_3d.labels_3d.tolist() == [2, 2]


def test_objects_are_sampled_into_synthetic_scans_on_their_ground(made: Path) -> None:
    """The whole stock pipeline. (Its ``ObjectSample`` clears the room of an object by a box turned
    the other way round, which costs the neighbours some points, in real scans alike.)"""
    torch.manual_seed(0)
    np.random.seed(0)
    dataset = detection(made)
    for slot in range(EXTRA):
        counts = inside(dataset[REAL + slot])
        assert len(counts) >= 2 and min(counts) >= 1


def test_boxes_are_bottom_centred_and_planes_point_up(made: Path) -> None:
    dataset = detection(made, [PACK_BOXES])
    folder = open_folder(made / "det")
    for slot in range(EXTRA):
        info = dataset.get_data_info(REAL + slot)
        scan = folder.scan(slot)
        boxes = info["ann_info"]["gt_bboxes_3d"].numpy()
        assert scan.boxes is not None
        floor = scan.boxes.values[:, 2] - scan.boxes.values[:, 5] / 2
        assert np.allclose(boxes[:, 2], floor, atol=1e-6) and np.array_equal(
            boxes[:, :2], scan.boxes.values[:, :2]
        )
        # The sensor stands 1.73 m above the road.
        assert info["plane"][2] > 0.99 and abs(info["plane"][3] - 1.73) < 0.05
        real = dataset.get_data_info(slot)["plane"]
        assert np.allclose(real, info["plane"], atol=0.05)


@pytest.mark.parametrize("mixer", ["LaserMix", "PolarMix", "FrustumMix"])
def test_partners_are_real_and_synthetic(
    made: Path, mixer: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Trap: partners come from the inner dataset, so that of two joined ones each would mix with
    itself only."""
    load = train_set("minkunet_semantickitti.py")["pipeline"][:3]
    step: dict[str, Any] = {"type": mixer, "pre_transform": load, "prob": 1.0}
    if mixer == "FrustumMix":
        pytest.importorskip(
            "frnet.datasets.transforms", reason="FRNet's repository is not on the path"
        )
        step |= {"H": 32, "W": 256, "fov_up": 3.0, "fov_down": -25.0, "num_areas": [4]}
    elif mixer == "LaserMix":
        step |= {"num_areas": [4], "pitch_angles": [-25, 3]}
    else:
        step |= {"instance_classes": [0], "swap_ratio": 1.0}
    dataset = segmentation(made, [step, PACK])
    drawn = []
    inner = dataset.get_data_info
    monkeypatch.setattr(dataset, "get_data_info", lambda i: drawn.append(i) or inner(i))
    np.random.seed(0)  # the trainer draws partners from it
    for i in range(len(dataset)):
        assert dataset[i]["inputs"]["points"].shape[0] > 100
    partners = drawn[1::2]
    assert {p >= REAL for p in partners} == {False, True}


def test_partners_follow_the_schedule(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Trap: the trainer draws them from the whole list, which has synthetic slots in epochs of real
    scans alone."""
    listed = write_infos(
        tmp_path / "seg",
        made / "sk" / "train.json",
        {
            "synthetic": made / "synthetic",
            "ratio": {0: 1.0, 1: 0.0},
            "epoch_size": REAL,
        },
        data_root=made / "sk",
    )
    load = train_set("minkunet_semantickitti.py")["pipeline"][:3]
    step: dict[str, Any] = {"type": "LaserMix", "pre_transform": load, "prob": 1.0}
    step |= {"num_areas": [4], "pitch_angles": [-25, 3]}
    dataset = segmentation(made, [step, PACK], ann_file=str(listed))
    repeated = {"type": "RepeatDataset", "times": 1, "dataset": dataset}
    sampler = adapter.SynthSampler(DATASETS.build(repeated))
    drawn = []
    inner = dataset.get_data_info
    monkeypatch.setattr(dataset, "get_data_info", lambda i: drawn.append(i) or inner(i))
    for epoch in (0, 1):
        sampler.set_epoch(epoch)
        drawn.clear()
        sampler.dataset.__getitems__(list(sampler))
        assert len(drawn) == 2 * REAL and {i < REAL for i in drawn} == {epoch == 1}


@pytest.mark.parametrize("ranks", [2, 8])
def test_every_rank_has_as_many_samples(made: Path, tmp_path: Path, ranks: int) -> None:
    """Also more ranks than twice the samples of an epoch."""
    settings = {"synthetic": made / "synthetic", "ratio": 0.5, "epoch_size": 3}
    where = {"data_root": made / "sk"}
    listed = write_infos(
        tmp_path / "seg", made / "sk" / "train.json", settings, **where
    )
    sampler = adapter.SynthSampler(segmentation(made, [PACK], ann_file=str(listed)))
    sampler.world_size = ranks
    sampler.num_samples = -(-3 // ranks)
    sampler.total_size = sampler.num_samples * ranks
    given = []
    for rank in range(ranks):
        sampler.rank = rank
        given.append([index for _, index in sampler])
    assert {len(share) for share in given} == {sampler.num_samples}
    drawn = {index for share in given for index in share}
    assert drawn == set(sampler.planned.entries(0).tolist())


def test_scans_without_a_box_are_not_replaced(made: Path, tmp_path: Path) -> None:
    """Trap: the stock setting replaces them, before ObjectSample can give them any, and the ratio
    is gone."""
    settings = MIX | {"synthetic": synthetic(tmp_path / "bare", 5, boxes=False)}
    where = {"data_root": made / "kitti", "points": "training/velodyne_reduced"}
    path = write_infos(
        tmp_path / "det", made / "kitti" / "train.json", settings, **where
    )
    dataset = detection(made, ann_file=str(path))
    samples = [dataset[i] for i in range(REAL + EXTRA)]
    assert [len(s["data_samples"].gt_instances_3d.labels_3d) > 0 for s in samples] == [
        True
    ] * (REAL + EXTRA)
    bare = detection(made, [PACK_BOXES], ann_file=str(path))
    counts = [
        len(bare[i]["data_samples"].gt_instances_3d.labels_3d)
        for i in range(REAL + EXTRA)
    ]
    assert [c > 0 for c in counts] == [True] * REAL + [False] * EXTRA
    with pytest.raises(ConfigError, match="filter_empty_gt=False"):
        detection(made, ann_file=str(path), filter_empty_gt=True)


def test_a_slot_is_read_by_url(made: Path) -> None:
    folder = open_folder(made / "seg")
    folder.epoch = 0
    url = f"lsynth://{made / 'seg'}/3"
    points = np.frombuffer(get(f"{url}.bin"), "<f4").reshape(-1, 4)
    assert np.array_equal(points[:, :3], folder.scan(3).points)
    labels = np.frombuffer(get(f"{url}.label"), "<u4") & 0xFFFF
    assert set(labels.tolist()) == {10, 40, 50}
    for wrong in (f"{url}.png", "lsynth://3.bin", f"{url}x.bin"):
        with pytest.raises(DataError, match="lsynth://<folder>"):
            read_url(wrong)


def test_scans_with_boxes_and_without_labels_serve_a_detector(
    made: Path, tmp_path: Path
) -> None:
    unlabelled = synthetic(tmp_path / "unlabelled", SYNTHETIC, labels=False)
    root = made / "kitti"
    listed = write_infos(
        tmp_path / "det",
        root / "train.json",
        MIX | {"synthetic": unlabelled, "labels": "boxes"},
        data_root=root,
        points="training/velodyne_reduced",
    )
    loaded = train_set(DETECTION) | {"ann_file": str(listed), "pipeline": []}
    dataset = DATASETS.build(loaded)
    infos = [dataset.get_data_info(i) for i in range(len(dataset))]
    made_up = [
        info
        for info in infos
        if info["lidar_points"]["lidar_path"].startswith("lsynth://")
    ]
    assert len(made_up) == EXTRA and all(
        len(info["ann_info"]["gt_labels_3d"]) > 0 for info in made_up
    )


def test_unsuitable_training_data_is_refused_before_training(
    made: Path, tmp_path: Path
) -> None:
    listed = made / "sk" / "train.json"
    root = {"data_root": made / "sk"}
    for labels in ("none", "ignore"):
        with pytest.raises(ConfigError, match="loss, a mean over no label, is NaN"):
            write_infos(
                tmp_path / "a",
                listed,
                MIX | {"synthetic": made / "synthetic", "labels": labels},
                **root,
            )
    unlabelled = synthetic(tmp_path / "unlabelled", 2, labels=False)
    with pytest.raises(ConfigError, match="a model or bank with labels"):
        write_infos(tmp_path / "b", listed, MIX | {"synthetic": unlabelled}, **root)
    with pytest.raises(ConfigError, match="setting of a mixture 'rate'"):
        write_infos(
            tmp_path / "d",
            listed,
            MIX | {"synthetic": made / "synthetic", "rate": 1},
            **root,
        )
    (tmp_path / "old.json").write_text("[]")
    with pytest.raises(DataError, match="no 'data_list'"):
        write_infos(
            tmp_path / "e",
            tmp_path / "old.json",
            MIX | {"synthetic": made / "synthetic"},
        )
    boxless = Path(tmp_path / "boxless")
    write_all("npz", boxless, [replace(street(i), boxes=None) for i in range(3)])
    with pytest.raises(DataError, match="no boxes.*labels: paste"):
        write_infos(
            tmp_path / "g",
            made / "kitti" / "train.json",
            MIX | {"synthetic": boxless},
            data_root=made / "kitti",
            points="training/velodyne_reduced",
        )
    named = tmp_path / "named"
    boxes = [scan.boxes for scan in map(street, range(3))]
    write_all(
        "npz",
        named,
        [
            replace(street(i), boxes=replace(b, names=("car",) * 3))
            for i, b in enumerate(boxes)
        ],
    )
    with pytest.raises(DataError, match="boxes of .'car'. in synthetic scan"):
        write_infos(
            tmp_path / "h",
            made / "kitti" / "train.json",
            MIX | {"synthetic": named},
            data_root=made / "kitti",
            points="training/velodyne_reduced",
        )


def test_other_synthetic_scans_than_the_lists_are_noticed(
    made: Path, tmp_path: Path
) -> None:
    source = synthetic(tmp_path / "s", 3)
    write_infos(
        tmp_path / "seg",
        made / "sk" / "train.json",
        MIX | {"synthetic": source},
        data_root=made / "sk",
    )
    next(source.rglob("*.npz")).unlink()
    with pytest.raises(DataError, match="not those of the list"):
        SlotFolder.open(tmp_path / "seg")


def test_classes_that_do_not_fit_are_refused(made: Path) -> None:
    adapter.SynthSampler(segmentation(made, [PACK]))
    meta = train_set("minkunet_semantickitti.py")["metainfo"]
    for changed in (
        {10: 4},
        {252: 19, 10: 19},
    ):  # a car that counts as another class, and as none
        wrong = {**meta, "seg_label_mapping": {**meta["seg_label_mapping"], **changed}}
        with pytest.raises(ConfigError, match="SemanticKITTI's 19 classes"):
            adapter.SynthSampler(segmentation(made, [PACK], metainfo=wrong))


def test_datasets_that_do_not_fit_are_refused(made: Path, tmp_path: Path) -> None:
    stock = train_set("minkunet_semantickitti.py") | {
        "ann_file": str(made / "sk" / "train.json")
    }
    with pytest.raises(
        ConfigError, match="SynthSampler with.*train.json.*write_infos wrote"
    ):
        adapter.SynthSampler(DATASETS.build(stock | {"data_root": str(made / "sk")}))
    with pytest.raises(
        ConfigError, match="KittiDataset with a mixed list.*SynthKittiDataset"
    ):
        adapter.SynthSampler(detection(made, [PACK_BOXES], type="KittiDataset"))
    with pytest.raises(ConfigError, match=f"4 of the {REAL + EXTRA} entries.*indices"):
        adapter.SynthSampler(segmentation(made, [PACK], indices=4))
    own = segmentation(made, [PACK])
    own.get_cat_ids = lambda number: [number % 2]
    with pytest.raises(ConfigError, match="ClassBalancedDataset.*balance=True"):
        adapter.SynthSampler(ClassBalancedDataset(own, 1e-3))
    wrapped = DATASETS.build({"type": "RepeatDataset", "times": 2, "dataset": own})
    assert len(adapter.SynthSampler(wrapped)) == 2 * (REAL + EXTRA)


@pytest.mark.parametrize("task", ["segmentation", "detection"])
def test_a_recipe_trains_40_epochs_and_validates(task: str, tmp_path: Path) -> None:
    if task == "detection":
        root = kitti(tmp_path / "real", REAL)
        (root / "ImageSets" / "val.txt").write_text("000004\n000005\n")
    else:
        root = semantic_kitti(tmp_path / "real", REAL)
        shutil.copytree(root / "sequences" / "00", root / "sequences" / "08")
    mix = DEFAULTS[task] | {"synthetic": str(synthetic(tmp_path / "s", 4))}
    write_files(configure("mmdet3d", task, mix, str(root), str(tmp_path)), tmp_path)
    runpy.run_path(str(tmp_path / "lists.py"))
    config = Config.fromfile(str(tmp_path / "mixed.py"))
    if task == "detection":  # the scans of the test have cars only
        sampler = config.train_dataloader.dataset.dataset.pipeline[2].db_sampler
        sampler.classes, sampler.sample_groups, sampler.prepare = (
            ["Car"],
            {"Car": 5},
            {},
        )
    train = DATASETS.build(config.train_dataloader.dataset)
    assert len(adapter.SynthSampler(train)) > 0 and train[0] is not None
    for loader in (config.val_dataloader, config.test_dataloader):
        held_out = DATASETS.build(loader.dataset)
        assert len(held_out) == (2 if task == "detection" else REAL)
        assert held_out[0]["inputs"]["points"].shape[1] == 4
    assert config.train_cfg.max_epochs == config.param_scheduler[-1].end == 40
    if task == "detection":
        assert Path(config.val_evaluator.ann_file).is_file()


@pytest.mark.parametrize("version", ["1.3.0", "2.0.0"])
def test_other_versions_are_refused(
    version: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mmdet3d, "__version__", version)
    monkeypatch.delitem(sys.modules, adapter.__name__)
    with pytest.raises(LibraryError, match=f"mmdet3d {version}.*install_mmdet3d.sh"):
        importlib.import_module(adapter.__name__)


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.py")), ids=lambda p: p.stem)
def test_configurations_change_data_only(path: Path) -> None:
    if path.stem.startswith("frnet"):
        pytest.importorskip(
            "frnet",
            reason="FRNet's repository is not on the path (PYTHONPATH and FRNET_ROOT)",
        )
    config = Config.fromfile(str(path))
    stock = re.findall(r'_base_ = \[\s*"(.+?)"', path.read_text())[0]
    stock = stock.replace("mmdet3d::", f"{Path(mmdet3d.__file__).parent}/.mim/configs/")
    ours = flat(bare(config.to_dict()))
    stock = stock.replace("{{$FRNET_ROOT:.}}", os.environ.get("FRNET_ROOT", "."))
    stock_config = bare(Config.fromfile(stock).to_dict())
    # the list itself is balanced
    if stock_config["train_dataloader"]["dataset"]["type"] == "CBGSDataset":
        stock_config["train_dataloader"]["dataset"] = stock_config["train_dataloader"][
            "dataset"
        ]["dataset"]
    theirs = flat(stock_config)
    changed = {key for key in ours if ours[key] != theirs.get(key)} | set(theirs) - set(
        ours
    )
    assert all(key.startswith((".train_dataloader", ".custom")) for key in changed)
    names = {key.rpartition(".")[2] for key in changed}
    defaults = {
        "backend_args",
        "test_mode",
    }  # left out where the dataset is written anew
    assert names <= {
        "imports",
        "allow_failed_imports",
        "custom_hooks",
        *defaults,
        *DATA_KEYS,
    }, changed
    assert {"type": "SynthEpochHook"} in [dict(h) for h in config.custom_hooks]


def test_the_view_is_the_cameras(made: Path) -> None:
    scan = Scan(
        np.array([(10, 0, 0), (-10, 0, 0), (10, 30, 0), (0.1, 0, -1)], np.float32),
        np.zeros(4, np.float32),
        open_scans(made / "synthetic").sensor,
    )
    assert np.array_equal(in_view(scan, CAMERA).points, scan.points[:1])


def test_the_database_is_drawn_from(made: Path) -> None:
    sampler = {
        "type": "DataBaseSampler",
        "data_root": str(made / "kitti"),
        "info_path": str(made / "kitti" / "dbinfos.pkl"),
        "rate": 1.0,
        "prepare": {"filter_by_difficulty": [-1], "filter_by_min_points": {"Car": 5}},
        "classes": ["Car"],
        "sample_groups": {"Car": 3},
        "points_loader": {
            "type": "LoadPointsFromFile",
            "coord_type": "LIDAR",
            "load_dim": 4,
            "use_dim": 4,
        },
    }
    found = TRANSFORMS.build(sampler).sample_all(
        np.zeros((0, 7), np.float32), np.zeros(0, np.int64)
    )
    assert found is not None and len(found["gt_labels_3d"]) >= 1
