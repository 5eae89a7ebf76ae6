"""What detectors need beside scans: ground planes, difficulty, object databases, boxes."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lidar_synth.integrations.detection import (
    difficulty,
    ground_plane,
    plane_in_camera,
    write_gt_database,
)
from lidar_synth.integrations.mixture import (
    mix_for_trainer,
)
from mixtures import as_is
from streets import CAMERA, held, street, synthetic

from lidar_synth.datasets.classes import GROUND, IGNORE
from lidar_synth.errors import DataError
from lidar_synth.geometry.scan import Boxes, Scan
from lidar_synth.labels import ObjectBank


@pytest.mark.parametrize("labels", ["all", "objects", "none"])
def test_the_ground_plane(labels: str) -> None:
    """Pasting into an unlabelled scan leaves the labels of the objects alone."""
    scan = street(3)
    assert scan.label is not None
    objects = np.where(GROUND[scan.label], IGNORE, scan.label).astype(np.uint8)
    known = {"all": scan.label, "objects": objects, "none": None}[labels]
    tilt = np.array([0.03, -0.02])
    lifted = scan.points + np.c_[
        np.zeros((len(scan), 2)), scan.points[:, :2] @ tilt
    ].astype(np.float32)
    tilted = replace(scan, points=lifted, label=known, raw_label=None)
    plane = ground_plane(tilted)
    normal = np.array([-tilt[0], -tilt[1], 1]) / np.linalg.norm([*tilt, 1])
    assert np.allclose(plane[:3], normal, atol=5e-3) and abs(plane[3] - 1.73) < 0.05
    seen = plane_in_camera(plane, CAMERA)
    assert seen[1] < -0.99 and abs(seen[3] - 1.73) < 0.05
    on_it = (
        tilted.points[tilted.label == 8][0]
        if labels == "all"
        else (0, 0, -plane[3] / plane[2])
    )
    moved = CAMERA.camera_from_sensor @ [*on_it, 1]
    assert abs(seen @ moved) < 0.05
    with pytest.raises(DataError, match="returns of the ground"):
        ground_plane(scan[:3])


def test_difficulty_is_kittis() -> None:
    boxes = Boxes(
        np.tile(np.array([10, 0, 0, 4, 2, 1.5, 0], np.float32), (6, 1)),
        ("Car",) * 6,
        truncation=np.array([0, 0.2, 0.4, 0.6, 0, 0]),
        occlusion=np.array([0, 1, 2, 0, -1, 3]),
        image_box=np.array([[0, 0, 100, 100]] * 6),
    )
    assert difficulty(boxes).tolist() == [0, 1, 2, -1, -1, -1]
    far = replace(
        boxes, values=boxes.values + np.array([100, 0, 0, 0, 0, 0, 0], np.float32)
    )
    assert difficulty(replace(far, image_box=None)).tolist() == [-1] * 6  # type: ignore[arg-type]


@pytest.mark.parametrize("origin", ["gravity", "bottom"])
def test_the_object_database(tmp_path: Path, origin: Any) -> None:
    """Of scans that have one name, as those of several folders may."""
    import pickle

    objects = ObjectBank.from_scans([replace(street(i), id="000000") for i in range(3)])
    path = write_gt_database(objects, tmp_path, origin=origin, infos="dbinfos.pkl")
    found = pickle.loads(path.read_bytes())["Car"]  # as the trainers read it
    assert len(found) == len(objects) == 9
    for i, info in enumerate(found):
        points = np.fromfile(tmp_path / info["path"], "<f4").reshape(-1, 4)
        assert len(points) == info["num_points_in_gt"] and info["difficulty"] == 0
        assert np.allclose(
            points[:, :3] + info["box3d_lidar"][:3], objects[i].scan.points, atol=1e-5
        )
        lift = 0 if origin == "gravity" else info["box3d_lidar"][5] / 2
        assert np.isclose(
            info["box3d_lidar"][2] + lift, objects.boxes.values[i, 2], atol=1e-5
        )


@pytest.mark.parametrize("layout", ["kitti", "nuscenes"])
def test_objects_of_unknown_occlusion_are_pasted_too(
    tmp_path: Path, layout: Any
) -> None:
    """Stock configurations leave out objects of difficulty -1."""
    import pickle

    scan = street(0)
    assert scan.boxes is not None
    bare = replace(
        scan, boxes=replace(scan.boxes, occlusion=None, truncation=None, image_box=None)
    )
    objects = ObjectBank.from_scans([bare])
    assert (objects.boxes.occlusion == -1).all()
    path = write_gt_database(
        objects, tmp_path, origin="bottom", infos="infos.pkl", layout=layout
    )
    found = [
        info["difficulty"]
        for infos in pickle.loads(path.read_bytes()).values()
        for info in infos
    ]
    assert len(found) == len(objects) and set(found) == {0}


def test_a_detectors_mixture_has_boxes_by_pasting(tmp_path: Path) -> None:
    """As a configuration says it: a bank of objects by its file, scans without a box."""
    ObjectBank.from_scans([street(i) for i in range(6)]).save(tmp_path / "objects.npz")
    settings = {
        "synthetic": synthetic(tmp_path / "bare", 4, boxes=False),
        "ratio": 0.5,
        "labels": {"paste": {"bank": str(tmp_path / "objects.npz"), "count": 4}},
    }
    given = mix_for_trainer(4, settings, as_is)
    scans = [s for s in (given[i] for i in range(len(given))) if isinstance(s, Scan)]
    assert len(scans) == 4
    found = [boxes for s in scans if (boxes := s.boxes) is not None]
    assert len(found) == 4 and sum(map(len, found)) >= 4
    for scan, boxes in zip(scans, found, strict=True):
        assert (held(boxes, scan.points) >= 5).all() and set(boxes.names) <= {"Car"}
        assert (difficulty(boxes) >= 0).all() and (boxes.occlusion >= 0).all()
