# ruff: noqa: E402, NPY002 - imports wait for what they need; trainers draw from numpy's global
# generator
"""OpenPCDet's own dataset, augmentor, collate code and ``train.py`` on mixed scans: OPENPCDET_ROOT
is a checkout.

It need not be built: ``openpcdet_cpu`` compiles what OpenPCDet has for a CPU, and says what these
tests do not show.
"""

import importlib
import pickle
import re
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from checkouts import SCRIPTS, checkout, needs, run_script

ROOT = checkout("OPENPCDET_ROOT", "OpenPCDet")
needs("skimage", "SharedArray", "spconv", "pyquaternion", "torchvision", "easydict")
sys.path.insert(0, str(SCRIPTS))
from openpcdet_cpu import prepare

prepare(ROOT)

import easydict
import lidar_synth.integrations.openpcdet as adapter
import pcdet
import torch
from layouts import write_all
from lidar_synth.integrations.detection import write_gt_database
from lidar_synth.integrations.folders import export_mixture
from lidar_synth.integrations.openpcdet import register
from pcdet.datasets import __all__ as registered
from pcdet.datasets.kitti import kitti_dataset
from pcdet.datasets.kitti.kitti_dataset import KittiDataset, create_kitti_infos
from streets import held, kitti, street, synthetic
from torch.utils.data import DataLoader

from lidar_synth.errors import ConfigError, DataError, LibraryError
from lidar_synth.formats import open_scans
from lidar_synth.formats.calibration import in_view
from lidar_synth.geometry.scan import Boxes
from lidar_synth.labels import ObjectBank
from lidar_synth.mixing import MixedScans

REAL = 6
EXTRA = 4
CLASSES = ["Car"]
VALIDATION = 2  # further real scans
NAME = "MixedKitti"


def config(
    root: Path, synthetic_scans: Path, sampling: bool = True, **settings: Any
) -> Any:
    """The stock data configuration for the tests' scans."""
    loaded = yaml.safe_load(
        (ROOT / "tools/cfgs/dataset_configs/kitti_dataset.yaml").read_text()
    )
    loaded["DATA_PATH"] = str(root)
    loaded["LIDAR_SYNTH"] = {
        "SYNTHETIC": str(synthetic_scans),
        "RATIO": 0.4,
        "SEED": 3,
        **settings,
    }
    augment = loaded["DATA_AUGMENTOR"]["AUG_CONFIG_LIST"]
    augment[0] |= {
        "SAMPLE_GROUPS": ["Car:3"],
        "PREPARE": {"filter_by_min_points": ["Car:5"]},
    }
    if not sampling:
        loaded["DATA_AUGMENTOR"]["DISABLE_AUG_LIST"] = ["gt_sampling"]
    return easydict.EasyDict(loaded)


def build(
    made: Path, scans: str | Path = "synthetic", kitti: str = "kitti", **options: Any
) -> Any:
    register()
    loaded = config(made / kitti, made / scans, **options)
    return registered[NAME](loaded, CLASSES, training=True, root_path=made / kitti)


def both(made: Path) -> tuple[Any, Any]:
    """The trainer's own training set and ours, of the same real scans; tools/bench/trainers.py
    times them."""
    loaded = config(made / "kitti", made / "synthetic")
    return KittiDataset(
        loaded, CLASSES, training=True, root_path=made / "kitti"
    ), build(made)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make(tmp_path_factory.mktemp("openpcdet"))


def make(root: Path) -> Path:
    """KITTI's folders, their info lists and GT database by OpenPCDet's own code, and synthetic
    scans."""
    synthetic(root / "synthetic", 11)
    synthetic(root / "bare", 5, boxes=False)
    kitti(root / "kitti", REAL + VALIDATION)
    write_infos(root / "kitti")
    return root


def write_infos(root: Path) -> None:
    kitti_dataset.Path = Path  # it imports that only when it is run as a script
    frames = [f"{i:06d}\n" for i in range(REAL + VALIDATION)]
    loaded = config(root, root)
    for split, part in {"val": frames[REAL:], "train": frames[:REAL]}.items():
        (root / "ImageSets" / f"{split}.txt").write_text("".join(part))
        dataset = KittiDataset(loaded, CLASSES, training=False, root_path=root)
        dataset.set_split(split)
        with (root / f"kitti_infos_{split}.pkl").open("wb") as file:
            pickle.dump(dataset.get_infos(num_workers=1), file)
    dataset.create_groundtruth_database(root / "kitti_infos_train.pkl", split="train")


def is_synthetic(name: Any) -> bool:
    return str(name).startswith("synthetic/")


def test_the_class_is_registered_beside_the_trainers_own(made: Path) -> None:
    register()
    assert issubclass(registered[NAME], KittiDataset) and create_kitti_infos is not None


def test_samples_have_the_weight_of_their_domain(made: Path) -> None:
    dataset = build(made, LOSS_WEIGHT=0.1)
    samples = [dataset[i] for i in range(len(dataset))]
    expected = [0.1 if dataset.domain(i) else 1.0 for i in range(len(dataset))]
    assert [s["loss_weight"] for s in samples] == pytest.approx(expected)
    batch = dataset.collate_batch(samples)
    assert batch["loss_weight"].tolist() == pytest.approx(expected)
    assert "loss_weight" not in build(made)[0]


@pytest.mark.parametrize("workers", [0, 2])
def test_two_epochs_see_exactly_the_planned_scans(made: Path, workers: int) -> None:
    dataset = build(made)
    loader = DataLoader(
        dataset,
        batch_size=2,
        shuffle=True,
        num_workers=workers,
        collate_fn=dataset.collate_batch,
    )
    numbers = {
        f"synthetic/{scan.id}": i
        for i, scan in enumerate(open_scans(made / "synthetic"))
    }
    seen = []
    for epoch in (0, 1):
        dataset.set_epoch(epoch)
        names = [name for batch in loader for name in batch["frame_id"]]
        assert Counter(map(is_synthetic, names)) == {False: REAL, True: EXTRA}
        assert sorted(n for n in names if not is_synthetic(n)) == [
            f"{i:06d}" for i in range(REAL)
        ]
        made_plan = dataset.mixed.plan()
        assert {numbers[n] for n in names if is_synthetic(n)} == set(
            made_plan.index[made_plan.domain].tolist()
        )
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
        for key in ("points", "gt_boxes", "voxels", "voxel_coords", "voxel_num_points"):
            assert mine[key].dtype == own[key].dtype and np.array_equal(
                mine[key], own[key]
            )


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
            # those on a face
            assert len(counts) >= 2 and np.abs(counts[:2] - before).max() <= 3


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
    dataset = build(made, sampling=False)
    dataset.data_processor.data_processor_queue.insert(0, no_boxes)
    for position in (i for i in range(len(dataset)) if dataset.domain(i)):
        with pytest.raises(
            DataError, match="synthetic scan '.*' has no box .*labels: paste"
        ):
            dataset[position]


def no_boxes(data_dict: Any) -> Any:
    """A step of OpenPCDet's processing after which no box is in range."""
    return data_dict | {"gt_boxes": data_dict["gt_boxes"][:0]}


def test_a_synthetic_scan_without_boxes_is_replaced_by_the_next_one(made: Path) -> None:
    """As when gt_sampling ends before the last epochs: a night's training goes on."""
    dataset = build(made, sampling=False)
    synthetic_ones = [i for i in range(len(dataset)) if dataset.domain(i)]
    names = [dataset[i]["frame_id"] for i in synthetic_ones]
    empty = dataset.mixed[synthetic_ones[-2]].id
    make = dataset._synthetic

    def without_boxes(scan: Any) -> Any:
        none = Boxes(np.zeros((0, 7), np.float32), ())
        return make(replace(scan, boxes=none) if scan.id == empty else scan)

    dataset._synthetic = without_boxes
    assert [dataset[i]["frame_id"] for i in synthetic_ones] == [
        *names[:-2],
        names[-1],
        names[-1],
    ]


def test_real_scans_without_boxes_are_replaced_by_real_ones(made: Path) -> None:
    dataset = build(made, sampling=False)
    inner = dataset.kitti_infos[2]["annos"]
    for key in inner:
        inner[key] = inner[key][:0]
    for seed in range(8):
        np.random.seed(seed)  # OpenPCDet draws the other scan from it
        names = [dataset[i]["frame_id"] for i in range(len(dataset))]
        assert (
            Counter(map(is_synthetic, names)) == {False: REAL, True: EXTRA}
            and "000002" not in names
        )


def test_the_trainers_generator_does_not_decide_on_scans(made: Path) -> None:
    """Trap: OpenPCDet seeds its workers the same in every epoch."""
    dataset = build(made)
    orders = []
    for epoch in (0, 1):
        dataset.set_epoch(epoch)
        np.random.seed(666)
        orders.append(
            [dataset[i]["frame_id"] for i in range(len(dataset)) if dataset.domain(i)]
        )
    assert not set(orders[0]) & set(orders[1])


def test_a_database_of_any_source_is_drawn_from(made: Path, tmp_path: Path) -> None:
    root = kitti(tmp_path / "kitti", REAL + VALIDATION)
    write_infos(root)
    objects = ObjectBank.from_scans(open_scans(made / "synthetic"))
    write_gt_database(
        objects,
        root,
        origin="gravity",
        folder="gt_town",
        infos="kitti_dbinfos_train.pkl",
    )
    register()
    loaded = config(root, made / "bare")
    loaded.DATA_AUGMENTOR.AUG_CONFIG_LIST[0].PREPARE["filter_by_difficulty"] = [-1]
    dataset = registered[NAME](loaded, CLASSES, training=True, root_path=root)
    sampler = dataset.data_augmentor.data_augmentor_queue[0]
    assert {info["path"].split("/")[0] for info in sampler.db_infos["Car"]} == {
        "gt_town"
    }
    np.random.seed(3)
    for position in (i for i in range(len(dataset)) if dataset.domain(i)):
        sample = dataset[position]
        boxes = Boxes(sample["gt_boxes"][:, :7], ("Car",) * len(sample["gt_boxes"]))
        assert held(boxes, sample["points"][:, :3]).min() >= 5


def test_its_converter_reads_an_exported_mixture(made: Path, tmp_path: Path) -> None:
    """Trap: it needs a test split before it makes the database of GT sampling."""
    real, synth = open_scans(made / "kitti"), open_scans(made / "synthetic")
    mixed = MixedScans(
        real, synth, 0.4, "boxes", to_sample=lambda scan, rng: scan, epoch_size=5
    )
    export_mixture(mixed, tmp_path, "kitti", validation=real, progress=False)
    create_kitti_infos(config(tmp_path, tmp_path), CLASSES, tmp_path, tmp_path, 1)
    infos = pickle.loads((tmp_path / "kitti_infos_train.pkl").read_bytes())
    assert len(infos) == 5 and (tmp_path / "kitti_dbinfos_train.pkl").is_file()


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
    with pytest.raises(
        ConfigError, match="planes without 1 scans .000003.*write_planes"
    ):
        registered[NAME](loaded, CLASSES, training=True, root_path=made / "kitti")
    plane.with_suffix(".gone").rename(plane)
    del loaded["LIDAR_SYNTH"]
    with pytest.raises(ConfigError, match="LIDAR_SYNTH_MIX=mix.yaml"):
        registered[NAME](loaded, CLASSES, training=True, root_path=made / "kitti")


@pytest.mark.parametrize("version", ["0.5.2", "1.0.0"])
def test_other_versions_are_refused(
    version: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pcdet, "__version__", version)
    monkeypatch.delitem(sys.modules, adapter.__name__)
    with pytest.raises(LibraryError, match=f"OpenPCDet {version}"):
        importlib.import_module(adapter.__name__)


def test_a_schedule_keeps_the_length_of_epochs(made: Path) -> None:
    assert len(build(made, RATIO=[0.2, 0.4])) == REAL + EXTRA


def test_synthetic_scans_that_cannot_be_trained_on_are_refused_before(
    made: Path, tmp_path: Path
) -> None:
    scans = [street(i) for i in range(4)]
    write_all(
        "npz", tmp_path / "without", [replace(scan, boxes=None) for scan in scans]
    )
    boxes = [scan.boxes for scan in scans]
    renamed = [
        replace(s, boxes=replace(b, names=("car",) * 3))
        for s, b in zip(scans, boxes, strict=True)
        if b
    ]
    write_all("npz", tmp_path / "named", renamed)
    for sampling in (True, False):
        with pytest.raises(
            DataError, match="synthetic scan '.*' has no boxes.*labels: paste"
        ):
            build(made, tmp_path / "without", sampling=sampling)
    with pytest.raises(
        DataError, match="boxes of .'car'. in synthetic scan .* some of Car"
    ):
        build(made, tmp_path / "named")
    some = [
        replace(s, boxes=replace(b, names=("Car", "car", "Car")))
        for s, b in zip(scans, boxes, strict=True)
        if b
    ]
    write_all("npz", tmp_path / "some", some)
    with pytest.raises(
        DataError,
        match="boxes of .'car'. in synthetic scan .* The trainer drops boxes of other names",
    ):
        build(made, tmp_path / "some")
    with pytest.raises(
        DataError, match="no box of .'Car'., and there is no gt_sampling"
    ):
        build(made, "bare", sampling=False)
    calib = made / "kitti" / "training" / "calib" / "000002.txt"
    calib.rename(calib.with_suffix(".gone"))
    with pytest.raises(ConfigError, match="calib without 1 scans .000002"):
        build(made)
    calib.with_suffix(".gone").rename(calib)


def small(made: Path, folder: Path, **data: Any) -> list[str]:
    """The arguments of ``train.py`` for stock PointPillars, only smaller, with cars only."""
    own = yaml.safe_load(
        (ROOT / "tools/cfgs/kitti_models/pointpillar.yaml").read_text()
    )
    own["DATA_CONFIG"] |= {
        "DATA_PATH": str(made / "kitti"),
        "POINT_CLOUD_RANGE": [0, -12.8, -3, 25.6, 12.8, 1],
    } | data
    own["DATA_CONFIG"]["DATA_PROCESSOR"][2]["VOXEL_SIZE"] = [0.4, 0.4, 4]
    sampling = own["DATA_CONFIG"]["DATA_AUGMENTOR"]["AUG_CONFIG_LIST"][0]
    sampling |= {
        "SAMPLE_GROUPS": ["Car:3"],
        "PREPARE": {"filter_by_min_points": ["Car:5"]},
    }
    own["CLASS_NAMES"] = CLASSES
    del own["MODEL"]["DENSE_HEAD"]["ANCHOR_GENERATOR_CONFIG"][1:]
    own["MODEL"]["BACKBONE_2D"] |= {
        "NUM_FILTERS": [16, 16, 16],
        "NUM_UPSAMPLE_FILTERS": [16, 16, 16],
    }
    own["MODEL"]["POST_PROCESSING"]["SCORE_THRESH"] = (
        0.01  # it learns little, and its boxes are to be evaluated
    )
    own["MODEL"]["POST_PROCESSING"]["NMS_CONFIG"]["NMS_POST_MAXSIZE"] = 20
    (folder / "small.yaml").write_text(yaml.safe_dump(own))
    mixture = {"synthetic": str(made / "synthetic"), "ratio": 0.4, "seed": 3}
    (folder / "mix.yaml").write_text(yaml.safe_dump(mixture))
    return [
        "train.py",
        "--cfg_file",
        str(folder / "small.yaml"),
        "--epochs",
        "2",
        "--batch_size",
        "2",
        "--workers",
        "2",
        "--logger_iter_interval",
        "1",
        "--wo_gpu_stat",
        "--set",
        "DATA_CONFIG.DATASET",
        NAME,
    ]


def trained(
    folder: Path, output: Path, arguments: list[str]
) -> tuple[list[list[str]], str]:
    """The training batches of a run of ``train.py``, and all that it said."""
    said = run_script(
        SCRIPTS / "openpcdet_cpu.py",
        *arguments,
        cwd=ROOT / "tools",
        mixture=folder / "mix.yaml",
        OPENPCDET_OUTPUT=str(output),
    )
    before, _, _ = said.partition("Start evaluation")
    return [
        yaml.safe_load(batch) for batch in re.findall(r"batch of (\[.*\])", before)
    ], said


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_its_own_script_trains_evaluates_and_resumes_from_our_launcher(
    made: Path, tmp_path: Path
) -> None:
    """``train.py`` as a user types it, with its evaluation, and resumed at the start and in the
    middle of an epoch.

    This does not show: OpenPCDet's GPU kernels of the overlaps of boxes, of which those for a CPU
    are used.
    """
    arguments = small(made, tmp_path)
    batches, said = trained(tmp_path, tmp_path / "whole", arguments)
    losses = [float(value) for value in re.findall(r"Loss: (\S+) ", said)]
    each = (REAL + EXTRA) // 2
    assert len(losses) == len(batches) == 2 * each and np.isfinite(losses).all()
    for epoch in (batches[:each], batches[each:]):
        assert Counter(is_synthetic(name) for batch in epoch for name in batch) == {
            False: REAL,
            True: EXTRA,
        }
    first, second = (
        {n for batch in part for n in batch if is_synthetic(n)}
        for part in (batches[:each], batches[each:])
    )
    assert not first & second
    assert re.search(
        r"Car AP_R40@0.70, 0.70, 0.70:\s*bbox AP:[\d., ]+\s*bev  AP:[\d., ]+\s*3d   AP:[\d., ]+",
        said,
    )

    end = next((tmp_path / "whole").rglob("checkpoint_epoch_1.pth"))
    state = torch.load(end, weights_only=False)
    assert state["it"] == each
    for done in (
        0,
        2,
    ):  # of the second epoch; OpenPCDet writes latest_model.pth in the middle of an epoch
        output = tmp_path / f"after-{done}"
        folder = output / end.parent.relative_to(tmp_path / "whole")
        folder.mkdir(parents=True)
        torch.save(state | {"it": each + done}, folder / "latest_model.pth")
        rest, _ = trained(tmp_path, output, arguments)
        assert rest == batches[each + done :]


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_its_own_script_refuses_scans_without_boxes_before_training(
    made: Path, tmp_path: Path
) -> None:
    write_all(
        "npz", tmp_path / "without", [replace(street(i), boxes=None) for i in range(4)]
    )
    arguments = small(made, tmp_path)
    (tmp_path / "mix.yaml").write_text(
        yaml.safe_dump({"synthetic": str(tmp_path / "without"), "labels": "generated"})
    )
    with pytest.raises(
        RuntimeError,
        match="has no boxes; expected boxes, or every object in it would be background",
    ):
        trained(tmp_path, tmp_path, arguments)
