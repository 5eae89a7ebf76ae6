"""Info lists for MMDetection3D: none of these tests needs the trainer."""

import json
import pickle
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from banks import some_image, write_bank
from layouts import MAKERS, write_all
from lidar_synth.integrations.detection import write_gt_database
from lidar_synth.integrations.mmdet3d_infos import write_infos
from lidar_synth.integrations.mmdet3d_lists import kitti_list, semantic_kitti_list
from lidar_synth.integrations.mmdet3d_slots import (
    SlotFolder,
    draw_in_epoch,
    open_folder,
    read_url,
    weight_of,
)
from lidar_synth.integrations.nuscenes import (
    CLASSES,
    as_nuscenes,
    five_values,
    turned_points,
)
from streets import held, kitti, semantic_kitti, street, synthetic

from lidar_synth.errors import ConfigError, DataError, FileError
from lidar_synth.formats import NuScenes, open_scans
from lidar_synth.geometry.scan import Scan
from lidar_synth.labels import ObjectBank
from lidar_synth.labels.mix import PasteObjects

REAL = 4
SLOTS = 4
MIX = {"ratio": 0.5, "seed": 3}
WHERE = {"points": "samples/LIDAR_TOP", "sweeps": "sweeps/LIDAR_TOP"}


@pytest.fixture(scope="module")
def scans(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of nine synthetic scans."""
    return synthetic(tmp_path_factory.mktemp("mmdet3d_lists") / "synthetic", 9)


def nuscenes_like(root: Path, **changes: Any) -> Path:
    """nuScenes' files, and a list as the trainer's ``create_data.py`` writes it."""
    entries = []
    for i in range(REAL):
        scan = replace(street(i), ring=None)
        names = [
            f"samples/LIDAR_TOP/{i}.pcd.bin",
            f"sweeps/LIDAR_TOP/{i}a.pcd.bin",
            f"sweeps/LIDAR_TOP/{i}b.pcd.bin",
        ]
        for name in names:
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            (root / name).write_bytes(
                five_values(as_nuscenes(scan)).astype("<f4").tobytes()
            )
        sweep = [
            {
                "timestamp": 9.95 - 0.05 * k,
                "lidar_points": {
                    "lidar_path": name,
                    "lidar2sensor": np.eye(4).tolist(),
                },
            }
            for k, name in enumerate(names[1:])
        ]
        box = {
            "bbox_3d": [0, 9, -1, 4, 2, 1.5, 0],
            "bbox_label_3d": 0 if i else 7,
            "num_lidar_pts": 9,
        }
        entries.append(
            {
                "sample_idx": i,
                "token": f"t{i}",
                "timestamp": 10.0,
                "images": {"CAM_FRONT": {"img_path": "a.jpg"}},
                "lidar_points": {"lidar_path": f"{i}.pcd.bin", "num_pts_feats": 5},
                "lidar_sweeps": sweep[: i % 3],
                "instances": [box | {"bbox_3d_isvalid": True, "velocity": [0.0, 0.0]}],
            }
            | changes
        )
    (root / "list.json").write_text(
        json.dumps({"metainfo": {"dataset": "nuscenes"}, "data_list": entries})
    )
    return root / "list.json"


@pytest.mark.parametrize("view", [None, False])
def test_a_list_without_kittis_camera_is_taken(
    scans: Path, tmp_path: Path, view: bool | None
) -> None:
    listed = nuscenes_like(tmp_path / "n")
    path = write_infos(
        tmp_path / "m",
        listed,
        MIX | {"synthetic": scans},
        data_root=tmp_path / "n",
        view=view,
        **WHERE,
    )
    entries = json.loads(path.read_text())["data_list"]
    assert len(entries) == REAL + SLOTS
    for real, slot in zip(entries[:REAL], entries[REAL:], strict=True):
        assert Path(real["lidar_points"]["lidar_path"]).is_file()
        assert all(
            Path(sweep["lidar_points"]["lidar_path"]).is_file()
            for sweep in real["lidar_sweeps"]
        )
        points = np.frombuffer(
            read_url(slot["lidar_points"]["lidar_path"]), "<f4"
        ).reshape(-1, 5)
        assert (
            points[:, 0].min() < -3 < 3 < points[:, 0].max() and points[:, 1].min() < -5
        ), "cropped to a view"
        assert 1 < points[:, 3].max() <= 255 and set(points[:, 4]) <= set(range(32))
        times = [
            [s["timestamp"] for s in entry["lidar_sweeps"]] for entry in (real, slot)
        ]
        assert times[0] == times[1]
        assert {s["lidar_points"]["lidar_path"] for s in slot["lidar_sweeps"]} <= {
            slot["lidar_points"]["lidar_path"]
        }
    with pytest.raises(ConfigError, match="view=True.*Leave view out"):
        write_infos(
            tmp_path / "v",
            listed,
            MIX | {"synthetic": scans},
            data_root=tmp_path / "n",
            view=True,
            **WHERE,
        )


def test_scans_in_nuscenes_form(tmp_path: Path) -> None:
    """Written in nuScenes' form and read by the reader of nuScenes, a scan is what it was."""
    scan = replace(street(0), pose=np.eye(4))
    turned = as_nuscenes(scan)
    assert turned.pose is None  # which is that of the other axes
    (tmp_path / "a.pcd.bin").write_bytes(five_values(turned).astype("<f4").tobytes())
    back = NuScenes(tmp_path, sensor=scan.sensor)[0]
    assert np.array_equal(back.points, scan.points) and np.array_equal(
        back.ring, turned.ring
    )  # type: ignore[arg-type]
    assert np.allclose(back.reflectance, scan.reflectance, atol=1e-6)
    assert turned.boxes is not None and scan.boxes is not None
    assert set(turned.boxes.names) == {"car"} and len(turned.boxes) == 3
    # Those on a face.
    assert (
        np.abs(held(turned.boxes, turned.points) - held(scan.boxes, scan.points)).max()
        <= 3
    )
    yaw = scan.boxes.values[:, 6]
    ahead = np.stack([np.cos(yaw), np.sin(yaw), 0 * yaw], 1)
    turn = turned.boxes.values[:, 6]
    found = np.stack([np.cos(turn), np.sin(turn), 0 * turn], 1)
    assert np.allclose(found, turned_points(ahead), atol=1e-6)


def test_names_of_boxes_become_nuscenes_classes() -> None:
    scan = street(0)
    assert scan.boxes is not None
    named = replace(
        scan, boxes=replace(scan.boxes, names=("Cyclist", "Tram", "traffic_cone"))
    )
    boxes = as_nuscenes(named).boxes
    assert (
        boxes is not None
        and boxes.names == ("bicycle", "traffic_cone")
        and set(boxes.names) <= set(CLASSES)
    )
    rider = replace(
        scan, boxes=replace(scan.boxes, names=("Motorcyclist", "Car", "Van"))
    )
    assert (as_nuscenes(rider).boxes or named.boxes).names == (
        "motorcycle",
        "car",
        "car",
    )
    with pytest.raises(DataError, match="boxes of .'car_x'. in scan.*Rename"):
        as_nuscenes(
            replace(scan, boxes=replace(scan.boxes, names=("Car", "car_x", "Car")))
        )
    far = Scan(
        scan.points[:1] + 500, scan.reflectance[:1], scan.sensor, boxes=scan.boxes
    )
    # nuScenes' trainers drop boxes without a return
    assert len(as_nuscenes(far).boxes or ()) == 0


def test_balanced_lists_hold_each_class_as_often(scans: Path, tmp_path: Path) -> None:
    listed = nuscenes_like(tmp_path / "n")
    path = write_infos(
        tmp_path / "m",
        listed,
        MIX | {"synthetic": scans},
        data_root=tmp_path / "n",
        balance=True,
        **WHERE,
    )
    entries = json.loads(path.read_text())["data_list"]
    labels = [e["instances"][0]["bbox_label_3d"] for e in entries if e["instances"]]
    assert sorted(labels) == [0, 0, 7, 7] and len(entries) == 8
    # Other classes, and boxes without a return, are none to be balanced.
    content = json.loads(listed.read_text())
    one, other = (content["data_list"][i]["instances"][0] for i in (1, 2))
    one["bbox_label_3d"] = -1
    other |= {"bbox_label_3d": 3, "bbox_3d_isvalid": False}
    listed.write_text(json.dumps(content))
    settings = {"synthetic": scans, "ratio": 0.0}
    where = {"data_root": tmp_path / "n", **WHERE}
    path = write_infos(tmp_path / "m", listed, settings, balance=True, **where)
    drawn = [e["sample_idx"] for e in json.loads(path.read_text())["data_list"]]
    assert sorted(drawn) == [0, 3]


def test_with_synthetic_scans_alone_real_ones_need_no_labels(
    scans: Path, tmp_path: Path
) -> None:
    MAKERS["semantic_kitti"](tmp_path / "real")
    for labels in (tmp_path / "real").rglob("labels"):
        shutil.rmtree(labels)
    listed = semantic_kitti_list(tmp_path / "real", tmp_path / "train.json")
    settings = MIX | {"synthetic": scans, "epoch_size": 4}
    where = {"data_root": tmp_path / "real"}
    with pytest.raises(FileError, match=r"labels/\d+.label, of the first entry"):
        write_infos(tmp_path / "some", listed, settings | {"ratio": 0.5}, **where)
    path = write_infos(tmp_path / "all", listed, settings | {"ratio": 1.0}, **where)
    assert len(json.loads(path.read_text())["data_list"]) == 3 + 4


def test_lists_that_do_not_fit_are_refused(scans: Path, tmp_path: Path) -> None:
    listed = nuscenes_like(tmp_path / "n")
    settings = MIX | {"synthetic": scans}
    with pytest.raises(
        FileError, match="of the first entry, does not exist.*data_prefix"
    ):
        write_infos(tmp_path / "a", listed, settings, data_root=tmp_path / "n")
    with pytest.raises(
        ConfigError, match="points of 5 values for layout='kitti'.*'nuscenes' .5."
    ):
        write_infos(
            tmp_path / "a",
            listed,
            settings,
            data_root=tmp_path / "n",
            layout="kitti",
            **WHERE,
        )
    with pytest.raises(ConfigError, match="layout='waymo'"):
        write_infos(
            tmp_path / "a",
            listed,
            settings,
            data_root=tmp_path / "n",
            layout="waymo",
            **WHERE,
        )
    bare = tmp_path / "bare"
    write_all("npz", bare, [replace(street(i), boxes=None) for i in range(5)])
    with pytest.raises(DataError, match="no boxes.*labels: paste"):
        write_infos(
            tmp_path / "a",
            listed,
            MIX | {"synthetic": bare},
            data_root=tmp_path / "n",
            **WHERE,
        )


def test_a_box_of_an_unknown_class_is_refused_beside_known_ones(tmp_path: Path) -> None:
    """Trap: the trainer would leave it out, and its points become background."""
    listed = kitti_list(kitti(tmp_path / "k", REAL), tmp_path / "k" / "train.json")
    scans = [street(i) for i in range(SLOTS)]
    assert scans[2].boxes is not None
    names = ("Car", "Bicycle", "Car")
    scans[2] = replace(scans[2], boxes=replace(scans[2].boxes, names=names))
    write_all("npz", tmp_path / "s", scans)
    where = {"data_root": tmp_path / "k", "points": "training/velodyne_reduced"}
    with pytest.raises(DataError, match="boxes of .'Bicycle'. in synthetic scan"):
        write_infos(
            tmp_path / "m", listed, MIX | {"synthetic": tmp_path / "s"}, **where
        )


@pytest.mark.parametrize("make", [semantic_kitti_list, kitti_list])
def test_a_lists_file_is_what_its_name_says(tmp_path: Path, make: Any) -> None:
    """The stock configurations name pickles, and the trainer chooses the reader by the name."""
    root = (semantic_kitti if make is semantic_kitti_list else kitti)(
        tmp_path / "real", 2
    )
    content = json.loads(make(root, tmp_path / "list.json").read_text())
    pickled = make(root, tmp_path / "list.pkl").read_bytes()
    assert pickle.loads(pickled) == content
    with pytest.raises(ConfigError, match=".txt; expected .json or .pkl"):
        make(root, tmp_path / "list.txt")


def test_a_share_of_semantic_kitti_is_spread_or_at_the_beginning_of_each_sequence(
    tmp_path: Path,
) -> None:
    root = semantic_kitti(tmp_path / "sk", 10)

    def frames(**options: Any) -> list[str]:
        entries = json.loads(
            semantic_kitti_list(root, tmp_path / "list.json", **options).read_text()
        )["data_list"]
        assert [e["sample_idx"] for e in entries] == list(range(len(entries)))
        return [e["sample_id"][-1] for e in entries]

    assert frames() == frames(order="sequential") == list("0123456789")
    assert frames(share=0.3) == list("036") and frames(
        share=0.3, order="sequential"
    ) == list("012")
    assert frames(share=0.01) == frames(share=0.01, order="sequential") == ["0"]
    for wrong in ({"share": 0}, {"share": 1.5}, {"order": "random"}):
        with pytest.raises(
            ConfigError, match="share|order 'random'; expected uniform or sequential"
        ):
            frames(**wrong)


def test_two_runs_that_share_a_list_have_their_own_epochs(
    scans: Path, tmp_path: Path
) -> None:
    real = semantic_kitti_list(
        semantic_kitti(tmp_path / "sk", REAL), tmp_path / "train.json"
    )
    write_infos(
        tmp_path / "m", real, MIX | {"synthetic": scans}, data_root=tmp_path / "sk"
    )
    runs = SlotFolder.open(tmp_path / "m"), SlotFolder.open(tmp_path / "m")
    before = {path: path.read_bytes() for path in (tmp_path / "m").iterdir()}
    runs[0].epoch = 0
    runs[1].epoch = 1
    seen = [{run.scan(slot).id for slot in range(SLOTS)} for run in runs]
    assert runs[0].epoch == 0 and not seen[0] & seen[1]
    assert {path: path.read_bytes() for path in (tmp_path / "m").iterdir()} == before


def test_a_list_may_begin_with_real_scans_alone(scans: Path, tmp_path: Path) -> None:
    """A detector's list needs the boxes of its slots before the first epoch."""
    real = semantic_kitti_list(
        semantic_kitti(tmp_path / "sk", REAL), tmp_path / "train.json"
    )
    settings = {"synthetic": scans, "ratio": {0: 0.0, 2: 0.5}}
    write_infos(tmp_path / "m", real, settings, data_root=tmp_path / "sk")
    early = SlotFolder.open(tmp_path / "m")
    late = SlotFolder.open(tmp_path / "m")
    late.epoch = 2
    assert early.slots == REAL
    for slot in range(REAL):
        assert early.scan(slot).id == late.scan(slot).id


@pytest.mark.parametrize("cached", [False, True])
def test_a_list_is_read_from_another_folder(
    scans: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cached: bool
) -> None:
    """Its settings name files relative to where it was written, also within others."""
    ObjectBank.from_scans(open_scans(scans)).save(tmp_path / "objects.npz")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path)
    write_bank(Path("bank"), [some_image(i) for i in range(4)])
    listed = nuscenes_like(tmp_path / "n")
    mix = MIX | {
        "synthetic": {"root": "bank"},
        "labels": {"paste": {"bank": Path("objects.npz"), "count": 2}},
    }
    if cached:
        url = (tmp_path / "bank").as_uri()
        mix["synthetic"] = {"root": url, "cache": "cache"}
    write_infos("m", listed, mix, data_root="n", **WHERE)
    monkeypatch.chdir("elsewhere")
    folder = SlotFolder.open(tmp_path / "m")
    assert folder.scan(0).boxes is not None and not list(Path().iterdir())
    mix["labels"] = PasteObjects("town", count=2)
    with pytest.raises(ConfigError, match="PasteObjects.*plain values.*{'paste'"):
        write_infos("m", listed, mix, data_root=tmp_path / "n", **WHERE)


@pytest.mark.parametrize("ratio", [0, {0: 0.0, 5: 0.0}])
def test_a_list_of_real_scans_alone_has_no_slots(
    scans: Path, tmp_path: Path, ratio: Any
) -> None:
    """The baseline: also a detector's, whose synthetic scans are looked at for boxes."""
    listed = nuscenes_like(tmp_path / "n")
    settings = MIX | {"synthetic": scans, "ratio": ratio}
    path = write_infos(
        tmp_path / "m", listed, settings, data_root=tmp_path / "n", **WHERE
    )
    assert len(json.loads(path.read_text())["data_list"]) == REAL
    folder = SlotFolder.open(tmp_path / "m")
    assert folder.slots == 0 and folder.entries(7).max() < REAL
    with pytest.raises(DataError, match="slot 0 of"):
        folder.scan(0)


@pytest.mark.parametrize(
    ("settings", "shares"),
    [
        ({"ratio": {0: 0.75, 2: 0.25}}, [(4, 12), (4, 12), (12, 4)]),
        ({"ratio": 1, "epoch_size": 6}, [(0, 6), (0, 6)]),
        ({"ratio": 0.5, "epoch_size": "replace"}, [(2, 2), (2, 2)]),
        (
            {
                "ratio": {"synthetic_first": 4},
                "epoch_size": 8,
                "loss_weight": {0: 1.0, 2: 0.1},
            },
            [(0, 8), (0, 8), (0, 8), (4, 4)],
        ),
        ({"epochs": 4}, [(0, 100), (0, 100), (0, 100), (50, 50)]),
    ],
    ids=["schedule", "ratio 1", "replace", "synthetic first", "recipe"],
)
def test_a_list_holds_schedules_and_lengths(
    scans: Path, tmp_path: Path, settings: dict[str, Any], shares: list[tuple[int, int]]
) -> None:
    """An epoch's entries, from which also partners are drawn, are those of its plan, and each slot
    has a scan of its own."""
    real = semantic_kitti_list(
        semantic_kitti(tmp_path / "sk", REAL), tmp_path / "train.json"
    )
    path = write_infos(
        tmp_path / "m",
        real,
        {"synthetic": scans, "seed": 3} | settings,
        data_root=tmp_path / "sk",
    )
    folder = open_folder(tmp_path / "m")
    listed = SimpleNamespace(get_data_info=int)
    partners = draw_in_epoch(tmp_path / "m", {"dataset": listed})["dataset"]
    assert (
        len(json.loads(path.read_text())["data_list"]) == REAL + folder.slots
        and not folder.whole
    )
    for epoch, (reals, slots) in enumerate(shares):
        entries = folder.entries(epoch)
        assert ((entries < REAL).sum(), (entries >= REAL).sum()) == (reals, slots)
        assert (
            sorted(entries[entries >= REAL] - REAL) == list(range(slots))
            and slots <= folder.slots
        )
        folder.epoch, plan = epoch, folder.mixed.plan(epoch)
        drawn = [partners.get_data_info(i) for i in range(len(partners))]
        assert drawn == entries.tolist()
        slot = int(entries[plan.domain][-1]) - REAL
        assert (
            folder.scan(slot).id
            == folder.mixed.sample(epoch, int(np.flatnonzero(plan.domain)[-1])).id
        )
    with pytest.raises(ConfigError, match="a number, a list or .epoch: ratio."):
        write_infos(
            tmp_path / "x",
            real,
            MIX | {"synthetic": scans, "ratio": min},
            data_root=tmp_path / "sk",
        )


def test_each_list_has_a_loss_weight_of_its_own(scans: Path, tmp_path: Path) -> None:
    """Several may be joined in one dataset."""
    real = semantic_kitti_list(
        semantic_kitti(tmp_path / "sk", REAL), tmp_path / "train.json"
    )
    found = []
    for name, weight in (("a", 0.5), ("b", {0: 0.2, 3: 0.1})):
        settings = MIX | {"synthetic": scans, "loss_weight": weight}
        path = write_infos(tmp_path / name, real, settings, data_root=tmp_path / "sk")
        entries = json.loads(path.read_text())["data_list"]
        paths = [entries[i]["lidar_points"]["lidar_path"] for i in (0, -1)]
        found += [[weight_of(path, epoch) for epoch in (0, 3)] for path in paths]
    assert found == [[1, 1], [0.5, 0.5], [1, 1], [0.2, 0.1]]


def test_lists_of_another_format_are_refused(scans: Path, tmp_path: Path) -> None:
    real = semantic_kitti_list(
        semantic_kitti(tmp_path / "sk", REAL), tmp_path / "train.json"
    )
    write_infos(
        tmp_path / "m", real, MIX | {"synthetic": scans}, data_root=tmp_path / "sk"
    )
    path = tmp_path / "m" / "mixture.json"
    path.write_text(path.read_text().replace("-mmdet3d/2", "-mmdet3d/1"))
    with pytest.raises(DataError, match="mmdet3d/1.*Write the list again"):
        SlotFolder.open(tmp_path / "m")


def test_objects_in_nuscenes_form(scans: Path, tmp_path: Path) -> None:
    objects = ObjectBank.from_scans(open_scans(scans))
    infos = write_gt_database(
        objects, tmp_path, origin="bottom", infos="db.pkl", layout="nuscenes"
    )
    found = pickle.loads(infos.read_bytes())
    assert set(found) == {"car"}
    for each in found["car"]:
        points = np.fromfile(tmp_path / each["path"], "<f4").reshape(-1, 5)
        length, width, height = each["box3d_lidar"][3:6]
        assert (
            len(each["box3d_lidar"]) == 9
            and not points[:, 4].any()
            and points[:, 3].max() > 1
        )
        assert (
            np.hypot(points[:, 0], points[:, 1]) <= np.hypot(length, width) / 2 + 0.1
        ).all()
        assert points[:, 2].min() >= -0.1 and points[:, 2].max() <= height + 0.1
