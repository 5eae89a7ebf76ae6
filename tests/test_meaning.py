"""Samples that mean something else than a trainer's own are named; those of other streets and
sensors are accepted."""

import logging
import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from lidar_synth import Town
from lidar_synth.cli import app
from lidar_synth.datasets.classes import IGNORE, SEMANTIC_KITTI
from lidar_synth.errors import ConfigError
from lidar_synth.formats import WRITERS, open_scans
from lidar_synth.geometry.scan import Scan
from lidar_synth.mixing import MixedScans
from lidar_synth.mixing.meaning import (
    ClassLook,
    contradictions,
    measure_tables,
    table_of,
)

Arrays = tuple[np.ndarray, np.ndarray]
"""(N, 4) float32 x, y, z, reflectance, and (N,) int64 labels."""


@cache
def streets(seed: int) -> list[Scan]:
    """Four scans of one stretch of a town."""
    town = Town(seed=seed, sensor="hdl32e", scans=4)
    return [town[i] for i in range(4)]


def arrays_of(scan: Scan) -> Arrays:
    assert scan.label is not None
    return np.column_stack([scan.points, scan.reflectance]).astype(
        np.float32
    ), scan.label.astype(np.int64)


def pointcept(points: np.ndarray, label: np.ndarray) -> Any:
    return {
        "coord": points[:, :3],
        "strength": points[:, 3:],
        "segment": label.astype(np.int32),
        "name": "x",
    }


def collected(points: np.ndarray, label: np.ndarray) -> Any:
    """Pointcept's after its transforms: a grid, tensors and joined features."""
    _, first = np.unique(np.floor(points[:, :3] / 0.3), axis=0, return_index=True)
    part = torch.from_numpy(points[first])
    return {
        "coord": part[:, :3],
        "feat": part,
        "segment": torch.from_numpy(label[first]),
        "offset": len(part),
    }


FORMS: dict[str, Callable[[np.ndarray, np.ndarray], Any]] = {
    "pointcept": pointcept,
    "pointcept, collected": collected,
    "open3d-ml": lambda p, s: {
        "point": p[:, :3],
        "feat": p[:, 3:],
        "label": (s + 1).astype(np.int32) % 256,
    },
    "waffleiron": lambda p, s: (
        np.vstack([p[:, 3], np.linalg.norm(p[:, :3], axis=1), p.T[:3]]),
        s,
        np.arange(len(p)),
    ),
    "cylinder3d": lambda p, s: (p[:, :3], s[:, None].astype(np.uint8), p[:, 3]),
    "openpcdet": lambda p, s: {
        "points": p,
        "gt_boxes": np.zeros((3, 8), np.float32),
        "frame_id": "0",
    },
    "mmdetection3d": lambda p, s: {
        "inputs": {"points": torch.from_numpy(p)},
        "data_samples": SimpleNamespace(
            gt_pts_seg=SimpleNamespace(pts_semantic_mask=torch.from_numpy(s))
        ),
    },
    "tuple": lambda p, s: (p, s),
}


def wrapped(
    form: str,
    wrong: Callable[[np.ndarray, np.ndarray], Arrays],
    real: list[Scan],
    synth: list[Scan],
) -> Any:
    """A mixture in a trainer's form whose synthetic samples have a mistake."""

    def to_sample(scan: Scan, rng: np.random.Generator) -> Any:
        return FORMS[form](*wrong(*arrays_of(scan)))

    theirs = [FORMS[form](*arrays_of(scan)) for scan in real]
    return MixedScans.wrap(theirs, synth, 0.5, to_sample=to_sample)


def unchanged(points: np.ndarray, label: np.ndarray) -> Arrays:
    return points, label


def scaled(*factors: float) -> Callable[[np.ndarray, np.ndarray], Arrays]:
    return lambda points, label: (points * np.array(factors, np.float32), label)


def numbered(
    change: Callable[[np.ndarray], np.ndarray],
) -> Callable[[np.ndarray, np.ndarray], Arrays]:
    """Other numbers of the classes; "ignore" stays."""
    return lambda points, label: (
        points,
        np.where(label == IGNORE, IGNORE, change(label)),
    )


def raw_ids(label: np.ndarray) -> np.ndarray:
    table = np.zeros(256, np.int64)
    table[: len(SEMANTIC_KITTI.from_train or ())] = SEMANTIC_KITTI.from_train
    return table[label]


MISTAKES: dict[str, tuple[Callable[[np.ndarray, np.ndarray], Arrays], str]] = {
    "classes too high": (
        numbered(lambda k: k + 1),
        "class 9 looks like your 8.*off by one",
    ),
    "classes too low": (
        numbered(lambda k: np.maximum(k - 1, 0)),
        "class 7 looks like your 8.*off by one",
    ),
    "raw ids": (numbered(raw_ids), "class 40 looks like your 8.*ids in files"),
    "reflectance x 255": (scaled(1, 1, 1, 255), "another scale"),
    "reflectance 0": (scaled(1, 1, 1, 0), "is always 0"),
    "z + 1.73": (
        lambda p, s: (p + np.float32([0, 0, 1.73, 0]), s),
        "the origin is at another height",
    ),
    "nuScenes' axes": (
        lambda p, s: (p[:, [1, 0, 2, 3]] * np.float32([-1, 1, 1, 1]), s),
        "roads run along y",
    ),
    "z inverted": (scaled(1, 1, -1, 1), "z points down"),
    "centimetres": (scaled(100, 100, 100, 1), "another (unit|scale)"),
}


@pytest.mark.parametrize("step", [-1, 1])
def test_of_two_directions_the_one_that_explains_more_is_told(step: int) -> None:
    [scan, *_] = streets(1)
    measured = measure_tables([table_of(scan)], [IGNORE])
    shares = {8: 0.5, 8 - 2 * step: 0.4, 8 - 4 * step: 0.1}
    real, synthetic = (
        replace(
            measured,
            classes={
                k + by: ClassLook(share, 0.0, 10.0) for k, share in shares.items()
            },
        )
        for by in (0, step)
    )
    [found] = contradictions(real, synthetic)
    assert f"class {8 + step} looks like your 8" in found.text
    assert "off by one" in found.text


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_named(mistake: str) -> None:
    wrong, message = MISTAKES[mistake]
    with pytest.raises(
        ConfigError, match=f"mean something else.*{message}.*compare=False"
    ):
        wrapped("tuple", wrong, streets(1), streets(2))


@pytest.mark.parametrize("form", FORMS)
def test_scans_of_another_street_are_accepted_in_every_trainers_form(
    form: str, caplog: Any
) -> None:
    wrapped(form, unchanged, streets(1), streets(2))
    assert "unlike" not in caplog.text


@pytest.mark.parametrize("form", [form for form in FORMS if form != "openpcdet"])
def test_mistakes_are_found_in_every_trainers_form(form: str) -> None:
    for mistake in (
        ("raw ids", "centimetres") if form != "open3d-ml" else ("centimetres",)
    ):
        with pytest.raises(ConfigError, match=MISTAKES[mistake][1]):
            wrapped(form, MISTAKES[mistake][0], streets(1), streets(2))


def test_the_ground_a_little_lower_is_only_reported(
    caplog: pytest.LogCaptureFixture,
) -> None:
    def lower(points: np.ndarray, label: np.ndarray) -> Arrays:
        return points - np.float32([0, 0, 0.7, 0]), label

    with caplog.at_level(logging.WARNING):
        wrapped("tuple", lower, streets(1), streets(2))
    assert "samples are unlike the real ones: [0]: the ground is at z =" in caplog.text


def write_folder(scans: list[Scan], root: Path) -> Path:
    writer = WRITERS["npz"](root)
    for index, scan in enumerate(scans):
        writer.write(scan, index)
    writer.finish()
    return root


def test_check_mix_shows_both_and_names_mistakes(tmp_path: Path) -> None:
    write_folder(streets(1), tmp_path / "real")
    settings = tmp_path / "mix.yaml"
    arguments = ["check-mix", str(settings), str(tmp_path / "real"), "--count", "4"]
    settings.write_text(
        f"synthetic: {write_folder(streets(2), tmp_path / 'synthetic')}\nratio: 0.1\n"
        "loss_weight: 0.5\nclasses: {car: 3, road: 4}\n"
    )
    done = CliRunner().invoke(app, [*arguments, "--out", str(tmp_path / "mix.png")])
    assert done.exception is None and (tmp_path / "mix.png").stat().st_size > 10_000
    for line in (
        "points of a scan",
        "rows in use",
        "ground, m",
        "reflectance: 1, 50, 99 %",
        "8 road",
        " m high  ",
    ):
        assert line in done.output
    trained = settings.read_text()
    for wrong, message in {
        "ratio: 1.5": "ratio 1.5 in epoch 0",
        "epochs: 3": "3 epochs.*at least 4",
        "ratio: 0": "without synthetic scans",
    }.items():
        settings.write_text(trained.replace("ratio: 0.1", wrong))
        done = CliRunner().invoke(app, arguments)
        assert re.search(message, str(done.exception)), wrong
    for late in ("ratio: {0: 0.0, 3: 0.5}", "epochs: 8"):
        settings.write_text(trained.replace("ratio: 0.1", late))
        assert CliRunner().invoke(app, arguments).exception is None
    upside_down = [
        replace(scan, points=scan.points * np.float32([1, 1, -1]))
        for scan in streets(2)
    ]
    settings.write_text(f"synthetic: {write_folder(upside_down, tmp_path / 'wrong')}\n")
    done = CliRunner().invoke(app, arguments)
    assert isinstance(done.exception, ConfigError) and "z points down" in str(
        done.exception
    )


def real_sources(real: Path, labelled: Path) -> dict[str, Any]:
    roots = {
        name: real / name
        for name in ("kitti360", "semantic_kitti", "kitti_object", "nuscenes")
    }
    roots |= {
        "raw": real / "kitti_raw" / "2011_09_26",
        "street": labelled / "semantic_kitti_consecutive",
    }
    return {name: open_scans(root) for name, root in roots.items()}


def test_no_real_dataset_is_refused_beside_another_or_the_town(
    real_scans: Path, labelled_scans: Path
) -> None:
    sources = real_sources(real_scans, labelled_scans)
    scans = {
        name: [source[i] for i in range(min(len(source), 4))]
        for name, source in sources.items()
    }
    scans["town"] = streets(2)
    measured = {
        name: measure_tables([table_of(scan) for scan in some], [IGNORE])
        for name, some in scans.items()
    }
    for name, ours in measured.items():
        for other, theirs in measured.items():
            assert not [
                each for each in contradictions(ours, theirs) if each.certain
            ], (
                name,
                other,
            )


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistakes_are_named_beside_real_scans(
    mistake: str, labelled_scans: Path
) -> None:
    source = open_scans(labelled_scans / "semantic_kitti_consecutive")
    with pytest.raises(ConfigError, match=MISTAKES[mistake][1]):
        wrapped(
            "tuple", MISTAKES[mistake][0], [source[i] for i in range(4)], streets(2)
        )
