# ruff: noqa: NPY002 - what trainers draw from
"""What the adapters share, and the traps that need no trainer to fall into; each trainer has a test
file of its own."""

import csv
import importlib
import json
from collections import Counter
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from banks import some_image, write_bank
from lidar_synth.integrations.detection import require_boxes
from lidar_synth.integrations.folders import MANIFEST, export_mixture, write_planes
from lidar_synth.integrations.mixture import (
    EpochLoader,
    class_ids,
    id_table,
    mix_for_trainer,
    points_of,
    read_settings,
    refuse_unlabelled,
    require_ids,
)
from lidar_synth.integrations.mmdet3d_infos import write_infos
from lidar_synth.integrations.mmdet3d_lists import (
    kitti_list,
    read_plane,
    semantic_kitti_list,
)
from lidar_synth.integrations.mmdet3d_slots import open_folder, read_url
from mixtures import SENSOR as SMALL, Endless, Scans, as_is
from streets import CAMERA, kitti, semantic_kitti, street, synthetic
from torch.utils.data import DataLoader, Dataset

from lidar_synth.datasets.classes import IGNORE, SEMANTIC_KITTI
from lidar_synth.errors import ConfigError, DataError, FileError, LibraryError
from lidar_synth.formats import KITTIObject, open_scans
from lidar_synth.formats.calibration import in_view
from lidar_synth.geometry.scan import Scan
from lidar_synth.labels.own import IgnoreLabels, RemoveLabels
from lidar_synth.mixing import MixedScans
from lidar_synth.mixing.settings import VARIABLE, open_synthetic


def test_synthetic_scans_by_name(tmp_path: Path) -> None:
    folder = synthetic(tmp_path / "scans", 2)
    made = open_synthetic(folder)
    assert len(made) == 2 and made.sensor == made[0].sensor
    given = Endless()
    assert open_synthetic(given) is given
    with pytest.raises(ConfigError, match="no such model"):
        open_synthetic("no such model")
    write_bank(tmp_path / "bank", [some_image(i) for i in range(3)])
    assert (
        len(open_synthetic(str(tmp_path / "bank")))
        == len(open_synthetic((tmp_path / "bank").as_uri()))
        == 3
    )


def test_a_folder_with_the_name_of_a_model_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It would be taken without a word in the place of the model."""
    synthetic(tmp_path / "town", 2)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=r"both a model and .*Write \./town for the"):
        mix_for_trainer(4, {"synthetic": "town", "ratio": 0.5}, as_is)
    assert len(open_synthetic("./town")) == len(open_synthetic(Path("town"))) == 2


def test_real_samples_of_a_mixture_are_numbers(tmp_path: Path) -> None:
    mixed = mix_for_trainer(6, {"synthetic": Endless(), "ratio": 0.4, "seed": 1}, as_is)
    samples = [mixed[i] for i in range(len(mixed))]
    assert sorted(s for s in samples if isinstance(s, int)) == list(range(6))
    assert sum(isinstance(s, Scan) for s in samples) == 4


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            {"synthetic": "bank", "rate": 0.5},
            "setting of a mixture 'rate'.*Did you mean 'ratio'",
        ),
        ({"ratio": 0.5}, "without synthetic scans"),
        ({"synthetic": Endless(), "ratio": 2}, "ratio 2"),
        (
            {"synthetic": Endless(fields=("reflectance",))},
            "a model or bank with labels",
        ),
    ],
)
def test_settings_that_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        mix_for_trainer(4, settings, as_is)
    with pytest.raises(ConfigError, match="no real scan.*PATH/dataset/sequences"):
        mix_for_trainer(0, {"synthetic": Endless()}, as_is)


def test_settings_come_from_a_file_or_the_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted = {"synthetic": "bank", "ratio": 0.5, "labels": {"paste": {"count": 8}}}
    path = tmp_path / "mix.yaml"
    path.write_text(
        yaml.safe_dump({"SYNTHETIC": "bank", "RATIO": 0.5, "LABELS": wanted["labels"]})
    )
    monkeypatch.delenv(VARIABLE, raising=False)
    with pytest.raises(ConfigError, match=f"{VARIABLE}=mix.yaml"):
        read_settings()
    monkeypatch.setenv(VARIABLE, str(path))
    assert read_settings() == read_settings(path) == read_settings(wanted) == wanted
    path.write_text("- 1")
    with pytest.raises(ConfigError, match="a dict of synthetic, epochs, ratio"):
        read_settings(path)


def test_a_batch_without_a_label_is_prevented() -> None:
    """Trap: the mean of a loss over no label is NaN."""
    scan = Scans("s", 1)[0]
    logits = torch.zeros(len(scan), 19, requires_grad=True)
    loss = torch.nn.CrossEntropyLoss(ignore_index=-1)
    nothing = replace(scan, label=np.full(len(scan), IGNORE, np.uint8))
    table = id_table(0, -1, np.int64)
    assert torch.isnan(loss(logits, torch.from_numpy(table[nothing.label])))  # type: ignore[index]
    assert torch.isfinite(loss(logits, torch.from_numpy(class_ids(scan, table))))
    for bare in (nothing, replace(scan, label=None)):
        with pytest.raises(DataError, match="no valid label"):
            class_ids(bare, table)
    for labels in ("none", "ignore", {"None": {}}, RemoveLabels(), IgnoreLabels()):
        with pytest.raises(ConfigError, match="is NaN"):
            refuse_unlabelled({"labels": labels}, "a trainer")
    refuse_unlabelled({}, "a trainer")


@pytest.mark.parametrize(("first", "ignore"), [(0, 19), (0, -1), (1, 0)])
def test_class_ids(first: int, ignore: int) -> None:
    table = id_table(first, ignore, np.int32)
    assert (
        table[:19].tolist() == list(range(first, first + 19))
        and (table[19:] == ignore).all()
    )


def test_a_map_of_classes_that_does_not_fit_is_refused() -> None:
    table = id_table(1, 0, np.uint8)
    stock = {raw: i + 1 for i, raw in enumerate(SEMANTIC_KITTI.from_train or ())} | {
        0: 0,
        252: 1,
    }
    require_ids(stock, table)
    require_ids(
        {raw: i - 1 if i else -1 for raw, i in stock.items()}, id_table(0, -1, np.int64)
    )
    for wrong, said in (({10: 4}, "with 10: 4.* 10: 1"), ({0: 1}, "with 0: 1.* 0: 0")):
        with pytest.raises(ConfigError, match=said):
            require_ids(stock | wrong, table)
    with pytest.raises(ConfigError, match="with 40: None"):
        require_ids({raw: i for raw, i in stock.items() if raw != 40}, table)


def test_boxes_that_a_trainer_does_not_know_are_refused() -> None:
    scan = street(0)
    assert scan.boxes is not None
    assert len(require_boxes(scan, ["Car", "Van"])) == 3
    assert len(require_boxes(street(0, boxes=False), ["Van"])) == 0
    with pytest.raises(
        DataError, match="boxes of .'Car'. in synthetic scan .* some of Van, Truck"
    ):
        require_boxes(scan, ["Van", "Truck"])
    some = replace(scan.boxes, names=("Car", "Car", "Bicycle"))
    with pytest.raises(DataError, match=r"boxes of \['Bicycle'\] in synthetic scan"):
        require_boxes(replace(scan, boxes=some), ["Car", "Van"])
    with pytest.raises(DataError, match="has no boxes.*labels: paste"):
        require_boxes(replace(scan, boxes=None), ["Car"])


def test_points_are_those_of_the_labels_in_memory_of_their_own() -> None:
    """Trap: trainers turn points in place."""
    scan = Scans("s", 1)[0]
    points = points_of(scan)
    assert np.array_equal(points, np.c_[scan.points, scan.reflectance])
    assert np.array_equal(class_ids(scan, np.arange(256)), scan.label)
    before = scan.points.copy()
    points[:] = 0
    assert np.array_equal(scan.points, before)


class Wrapped(Dataset[Any]):
    def __init__(self, dataset: Any) -> None:
        self.point_cloud_dataset = dataset

    def __len__(self) -> int:
        return len(self.point_cloud_dataset)

    def __getitem__(self, index: int) -> Any:
        return self.point_cloud_dataset[index]


@pytest.mark.parametrize("persistent", [False, True])
def test_the_loader_tells_the_epoch(persistent: bool) -> None:
    """Trap: an attribute set in the main process never reaches workers that persist."""
    mixed = mix_for_trainer(6, {"synthetic": Endless(), "ratio": 0.4}, as_is)
    loader = EpochLoader(
        Wrapped(mixed),
        batch_size=2,
        num_workers=2,
        collate_fn=list,
        persistent_workers=persistent,
        shuffle=True,
    )
    seen = []
    for epoch in range(3):
        samples = [sample for batch in loader for sample in batch]
        names = {s.id for s in samples if isinstance(s, Scan)}
        made = mixed.plan(epoch)
        assert names == {f"s{n}" for n in made.index[made.domain]}
        assert Counter(isinstance(s, Scan) for s in samples) == {False: 6, True: 4}
        seen.append(names)
    assert not seen[0] & seen[1] and not seen[1] & seen[2]


def test_trainers_generators_do_not_decide_on_scans() -> None:
    """Trap: some seed their workers the same in every epoch."""
    settings = {"synthetic": Endless(), "ratio": 0.4}
    mixed = mix_for_trainer(
        6, settings, lambda scan, rng: (scan.id, int(rng.integers(1 << 60)))
    )
    given = []
    for seed in (0, 1):
        np.random.seed(seed)
        torch.manual_seed(seed)
        given.append([mixed[i] for i in range(len(mixed))])
    assert given[0] == given[1]


@pytest.fixture
def mixed(tmp_path: Path) -> MixedScans:
    real = [replace(street(i), domain=0) for i in range(3)]
    return MixedScans(
        real,
        open_synthetic(synthetic(tmp_path / "synthetic", 4)),
        ratio=0.4,
        seed=2,
        to_sample=as_is,
    )


def test_a_mixture_as_semantic_kitti(mixed: MixedScans, tmp_path: Path) -> None:
    """Trap: trainers read a missing ``.label`` as zeros, "car" for one of them: every scan has its
    own."""
    assert (
        export_mixture(mixed, tmp_path / "out", "semantic_kitti", progress=False) == 5
    )
    read = open_scans(tmp_path / "out", split="train")
    for i, scan in enumerate(read):
        assert np.array_equal(scan.points, mixed[i].points) and np.array_equal(
            scan.label, mixed[i].label
        )
    labels = list((tmp_path / "out" / "sequences" / "00" / "labels").iterdir())
    assert len(labels) == len(read) == 5
    rows = list(csv.reader((tmp_path / "out" / MANIFEST).read_text().splitlines()[1:]))
    assert [int(row[1]) for row in rows] == [mixed.domain(i) for i in range(5)]
    assert (
        export_mixture(mixed, tmp_path / "out", "semantic_kitti", progress=False) == 0
    )
    with pytest.raises(
        ConfigError, match="was filled with .*plan.* or choose another folder"
    ):
        export_mixture(
            mixed, tmp_path / "out", "semantic_kitti", epoch=1, progress=False
        )
    thin_real = {"augment": lambda scan, rng: scan if scan.domain else scan[::2]}
    for options in ({"labels": "none"}, thin_real | {"augment_real": True}):
        other = MixedScans(
            mixed.real[0],
            mixed.synthetic[0],
            ratio=0.4,
            seed=2,
            to_sample=as_is,
            **options,
        )
        with pytest.raises(ConfigError, match="was filled with"):
            export_mixture(other, tmp_path / "out", "semantic_kitti", progress=False)


def test_a_mixture_as_kitti_objects(mixed: MixedScans, tmp_path: Path) -> None:
    root = tmp_path / "out"
    assert export_mixture(mixed, root, "kitti", calibration=CAMERA, progress=False) == 5
    for kind, suffix in [
        ("velodyne", "bin"),
        ("label_2", "txt"),
        ("calib", "txt"),
        ("image_2", "png"),
        ("planes", "txt"),
    ]:
        assert sorted(p.name for p in (root / "training" / kind).iterdir()) == [
            f"{i:06d}.{suffix}" for i in range(5)
        ]
    assert (root / "ImageSets" / "train.txt").read_text().split() == [
        f"{i:06d}" for i in range(5)
    ]
    [test] = KITTIObject(root, "test")  # which trainers' converters need
    assert np.array_equal(test.points, mixed[0].points)
    for i, scan in enumerate(KITTIObject(root, "train")):
        assert scan.boxes is not None and len(scan.boxes) == 2
        seen = in_view(mixed[i], CAMERA)
        assert seen.boxes is not None
        # two decimals
        assert np.abs(scan.boxes.values - seen.boxes.values).max() < 0.02
        plane = read_plane(root / "training" / "planes" / f"{i:06d}.txt")
        assert np.allclose(plane, (0, -1, 0, 1.73), atol=0.05)  # in the camera's axes


@pytest.mark.parametrize("layout", ["semantic_kitti", "kitti"])
def test_an_export_has_validation_apart_from_training(
    mixed: MixedScans, tmp_path: Path, layout: Any
) -> None:
    held = [street(i) for i in (7, 8)]
    options = {"calibration": CAMERA, "validation": held, "progress": False}
    assert export_mixture(mixed, tmp_path / "out", layout, **options) == 7
    assert export_mixture(mixed, tmp_path / "out", layout, **options) == 0
    if layout == "semantic_kitti":  # trainers list the folders of all sequences
        folders = [tmp_path / "out" / "sequences" / f"{i:02d}" for i in range(11)]
        counts = [len(list((each / "velodyne").iterdir())) for each in folders]
        assert counts == [5, *[0] * 7, 2, 0, 0]
    with pytest.raises(ConfigError, match="was filled with .*validation"):
        others = {"validation": [street(i) for i in (8, 9)]}
        export_mixture(mixed, tmp_path / "out", layout, **options | others)
    train, val = (
        open_scans(tmp_path / "out", split=split) for split in ("train", "val")
    )
    assert len(train) == 5 and len(val) == 2
    for scan, own in zip(val, held, strict=True):
        if layout == "kitti":
            scan, own = in_view(scan, CAMERA), in_view(own, CAMERA)
            assert scan.boxes and own.boxes and len(scan.boxes) == len(own.boxes)
        assert np.array_equal(scan.points, own.points)


def test_scans_without_labels_are_not_exported(tmp_path: Path) -> None:
    """Trap: KITTI-360 has no label per scan."""
    real = [replace(street(i), label=None, raw_label=None) for i in range(2)]
    mixed = MixedScans(
        real, Scans("s", 3, street(0).sensor, 1), ratio=0.5, to_sample=as_is
    )
    with pytest.raises(DataError, match="has no label.*label policy"):
        export_mixture(mixed, tmp_path, "semantic_kitti", progress=False)
    with pytest.raises(ConfigError, match="to_sample"):
        export_mixture(
            MixedScans(real, Scans("s", 3, street(0).sensor, 1)),
            tmp_path / "kitti",
            "kitti",
            progress=False,
        )
    with pytest.raises(ConfigError, match="'semantic_kitti' or 'kitti'"):
        export_mixture(mixed, tmp_path, "kitti360")  # type: ignore[arg-type]


def test_missing_planes_are_fitted(tmp_path: Path) -> None:
    root = kitti(tmp_path, 2)
    planes = sorted((root / "training" / "planes").iterdir())
    planes[0].write_text("# Matrix\nWIDTH 4\nHEIGHT 1\n0 -1 0 1.5\n")
    planes[1].unlink()
    assert write_planes(root) == 1
    assert read_plane(planes[0]).tolist() == [0, -1, 0, 1.5]
    planes[1].write_text("0 -1 0 1.5")
    with pytest.raises(DataError, match="four, the plane in the last one"):
        read_plane(planes[1])


def test_lists_for_mmdetection3d(tmp_path: Path) -> None:
    root = kitti(tmp_path / "kitti", 2)
    entries = json.loads(kitti_list(root, tmp_path / "k.json").read_text())["data_list"]
    for i, entry in enumerate(entries):
        scan = KITTIObject(root, "train")[i]
        assert (
            scan.boxes is not None and len(entry["instances"]) == len(scan.boxes) == 2
        )
        place = np.array(entry["instances"][0]["bbox_3d"][:3])
        dims = entry["instances"][0]["bbox_3d"][3:6]
        centre = CAMERA.sensor_from_camera @ [*(place - [0, dims[1] / 2, 0]), 1]
        assert np.allclose(centre[:3], scan.boxes.values[0, :3], atol=1e-4)
        assert np.allclose(dims, scan.boxes.values[0, [3, 5, 4]], atol=1e-5)
        reduced = np.fromfile(
            root
            / "training"
            / "velodyne_reduced"
            / entry["lidar_points"]["lidar_path"],
            "<f4",
        )
        assert np.array_equal(
            reduced.reshape(-1, 4)[:, :3], in_view(scan, CAMERA).points
        )
    (root / "training" / "calib" / "000001.txt").unlink()
    (root / "training" / "planes" / "000001.txt").unlink()
    with pytest.raises(FileError, match="calib/000001.txt cannot be read"):
        kitti_list(root, tmp_path / "k.json")
    with pytest.raises(DataError, match="has no calibration.*calib/000001.txt"):
        write_planes(root)
    listed = semantic_kitti_list(
        semantic_kitti(tmp_path / "sk", 2), tmp_path / "s.json"
    )
    for entry in json.loads(listed.read_text())["data_list"]:
        assert (tmp_path / "sk" / entry["lidar_points"]["lidar_path"]).is_file()
        assert (tmp_path / "sk" / entry["pts_semantic_mask_path"]).is_file()


def test_a_list_for_mmdetection3d_has_the_regions_without_boxes(tmp_path: Path) -> None:
    """Its evaluation names every instance by the list's categories, and excuses detections in
    ``DontCare`` regions."""
    root = kitti(tmp_path, 1)
    file = root / "training" / "label_2" / "000000.txt"
    region = "DontCare -1 -1 -10 10 20 30 40.5 -1 -1 -1 -1000 -1000 -1000 -10\n"
    file.write_text(file.read_text().replace("Car", "Bus", 1) + region)
    listed = json.loads(kitti_list(root, tmp_path / "k.json").read_text())
    names = {number: n for n, number in listed["metainfo"]["categories"].items()}
    found = listed["data_list"][0]["instances"]
    labels = [names[each["bbox_label"]] for each in found]
    assert labels == ["DontCare", "Car", "DontCare"]
    excused = found[-1]
    assert excused["bbox"] == [10, 20, 30, 40.5] and excused["bbox_label_3d"] == -1
    assert excused["group_id"] == 2 and excused["index"] == -1
    assert excused.keys() == found[0].keys()  # the trainer takes those of the first


def test_urls_of_a_mixed_list(tmp_path: Path) -> None:
    real = kitti_list(kitti(tmp_path / "real", 2), tmp_path / "train.json")
    made = synthetic(tmp_path / "made", 2, labels=False)
    settings = {"synthetic": made, "ratio": 0.5, "labels": "boxes"}
    where = {"data_root": tmp_path / "real", "points": "training/velodyne_reduced"}
    folder = write_infos(tmp_path / "mixed", real, settings, **where).parent
    points = np.frombuffer(read_url(f"lsynth://{folder}/1.bin"), "<f4").reshape(-1, 4)
    assert np.array_equal(points, points_of(open_folder(folder).scan(1)))
    with pytest.raises(DataError, match="no valid label"):
        read_url(f"lsynth://{folder}/1.label")
    with pytest.raises(FileError, match="mixture.json"):
        read_url(f"lsynth://{made}/1.bin")


@pytest.mark.parametrize(
    ("adapter", "trainer"),
    [
        ("mmdet3d", "mmdet3d"),
        ("pointcept", "pointcept"),
        ("lightning", "lightning"),
        ("openpcdet", "pcdet"),
    ],
)
def test_a_missing_trainer_is_named(adapter: str, trainer: str) -> None:
    if find_spec(trainer) is not None:
        pytest.skip(f"{trainer} is installed")
    with pytest.raises(LibraryError, match=f"{trainer} cannot be imported"):
        importlib.import_module(f"lidar_synth.integrations.{adapter}")


def test_other_missing_trainers_are_named() -> None:
    from lidar_synth.integrations import cylinder3d, rangenet, waffleiron

    if any(find_spec(name) for name in ("dataloader", "tasks", "waffleiron")):
        pytest.skip("a checkout is on the path")
    for adapter in (cylinder3d, rangenet, waffleiron):
        with pytest.raises(LibraryError, match="cannot be imported"):
            adapter.register()


def test_the_stand_in_for_torch_scatter() -> None:
    path = Path(__file__).parent.parent / "tools" / "stand_ins" / "torch_scatter.py"
    from importlib.util import module_from_spec, spec_from_file_location

    spec = spec_from_file_location("stand_in_scatter", path)
    assert spec is not None and spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    values = torch.randn(20, 3)
    index = torch.randint(0, 4, (20,))
    index[:4] = torch.arange(4)
    for i in range(4):
        assert torch.equal(
            module.scatter_max(values, index, dim=0)[0][i], values[index == i].amax(0)
        )
        assert torch.allclose(
            module.scatter_mean(values, index, dim=0)[i], values[index == i].mean(0)
        )


def test_loaders_take_a_mixture_of_plain_items() -> None:
    """Trap: collate wants the same keys in every sample, with labels, boxes and confidence or
    without."""
    real = [
        replace(s, label=None, raw_label=None) if i % 2 else s
        for i, s in enumerate(Scans("r", 6))
    ]
    mixed = MixedScans(Scans("r", 0, SMALL) or real, Endless(), ratio=0.4)
    loader = DataLoader(mixed, batch_size=5, collate_fn=mixed.collate)
    assert [sorted(batch) for batch in loader] == [
        sorted(mixed.collate([mixed[0], mixed[1]]))
    ] * 2
