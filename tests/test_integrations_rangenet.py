# ruff: noqa: E402, NPY002 - imports wait for what they need; trainers draw from numpy's global
# generator
"""RangeNet++'s, SalsaNext's or CENet's own parser and script on mixed scans; RANGENET_ROOT is a
checkout of one."""

import os
import random
import re
import sys
from collections import Counter
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from checkouts import checkout
from launched import clone, epochs, launched
from lidar_synth.integrations.removed import provide
from streets import SENSOR, semantic_kitti, synthetic

ROOT = checkout("RANGENET_ROOT", "lidar-bonnetal, SalsaNext or CENet")
CENET = (ROOT / "modules/trainer.py").is_file()
sys.path.append(str(ROOT if CENET else ROOT / "train"))
# as the launcher does
provide("numpy.float", "imp", "tensorflow.summary", "torchvision")

from lidar_synth.integrations.rangenet import filled, gaps, make_parser

from lidar_synth.errors import ConfigError, LibraryError
from lidar_synth.formats import open_scans
from lidar_synth.generate.generator import Generated
from lidar_synth.generate.loading import load_generator

REAL = 6
EXTRA = 4
BATCH = 2
stock = import_module(
    "dataset.kitti.parser" if CENET else "tasks.semantic.dataset.kitti.parser"
)
SALSA = hasattr(stock, "my_collate") and not CENET
ARCH = (
    "senet-1024p.yml"
    if CENET
    else "salsanext.yml"
    if SALSA
    else "config/arch/squeezeseg.yaml"
)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make(tmp_path_factory.mktemp("rangenet"))


def make(root: Path) -> Path:
    """Real and synthetic scans, and the settings of a mixture."""
    semantic_kitti(root / "sk", REAL)
    synthetic(root / "synthetic", 11)
    mixture = {"synthetic": str(root / "synthetic"), "ratio": 0.4, "seed": 3}
    (root / "mix.yaml").write_text(yaml.safe_dump(mixture))
    return root


def data() -> dict[str, Any]:
    found = next(ROOT.rglob("config/labels/semantic-kitti.yaml"))
    return yaml.safe_load(found.read_text())  # type: ignore[no-any-return]


def arguments(made: Path, **others: Any) -> dict[str, Any]:
    labels = data()
    sensor = {
        "name": "HDL64",
        "type": "spherical",
        "fov_up": 3,
        "fov_down": -25,
        "img_prop": {"width": SENSOR.columns, "height": SENSOR.rows},
        "img_means": [12.12, 10.88, 0.23, -1.04, 0.21],
        "img_stds": [12.32, 11.47, 6.91, 0.86, 0.16],
    }
    return {
        "root": str(made / "sk"),
        "train_sequences": [0],
        "valid_sequences": [0],
        "test_sequences": None,
        **{
            key: labels[key]
            for key in ("labels", "color_map", "learning_map", "learning_map_inv")
        },
        "sensor": sensor,
        "max_points": 20000,
        "batch_size": BATCH,
        "workers": 0,
        "gt": True,
        "shuffle_train": True,
    } | others


def parser(made: Path, **others: Any) -> Any:
    return make_parser(stock, made / "mix.yaml")(**arguments(made, **others))


def both(made: Path) -> tuple[Any, Any]:
    """The trainer's own training set and ours, of the same real scans; tools/bench/trainers.py
    times them."""
    keys = (
        "labels",
        "color_map",
        "learning_map",
        "learning_map_inv",
        "sensor",
        "max_points",
        "gt",
    )
    options = {key: arguments(made)[key] for key in keys} | (
        {"transform": True} if SALSA or CENET else {}
    )
    return stock.SemanticKitti(str(made / "sk"), [0], **options), parser(
        made
    ).train_dataset


def test_two_epochs_see_exactly_the_planned_scans(
    made: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made_parser = parser(made, workers=2)
    loader = made_parser.get_train_set()
    seen = []
    assert made_parser.get_train_size() == (REAL + EXTRA) // BATCH
    if SALSA:  # its batches tell no names
        loader.collate_fn = torch.utils.data.default_collate
    for epoch in (0, 1):
        loader.dataset.set_epoch(epoch)  # the launcher does
        batches = list(loader)
        names = [
            (s, n) for batch in batches for s, n in zip(batch[4], batch[5], strict=True)
        ]
        assert Counter(s for s, _ in names) == {"00": REAL, "synthetic": EXTRA}
        made_plan = loader.dataset.mixed.plan(epoch)
        wanted = {f"{n:06d}.label" for n in made_plan.index[made_plan.domain]}
        assert {n for s, n in names if s == "synthetic"} == wanted
        seen.append(wanted)
    assert not seen[0] & seen[1]


def test_the_trainers_own_collate_takes_both_kinds(made: Path) -> None:
    batches = list(parser(made).get_train_set())
    assert len(batches) == (REAL + EXTRA) // BATCH
    for batch in batches:
        assert (
            batch[0].shape[1:] == (5, SENSOR.rows, SENSOR.columns)
            and batch[2].max() <= 19
        )


def test_real_samples_are_the_trainers_own(made: Path) -> None:
    own, dataset = both(made)
    for position in (i for i in range(len(dataset)) if not dataset.mixed.domain(i)):
        samples = []
        for each, index in ((dataset, position), (own, dataset.mixed[position])):
            np.random.seed(3)
            random.seed(30)
            samples.append(each[index])
        for a, b in zip(*samples, strict=True):
            assert torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b


def test_labels_arrive_in_the_trainers_ids(made: Path) -> None:
    dataset = parser(made).train_dataset
    source = open_scans(made / "synthetic")
    dataset.transform = False
    for position in (i for i in range(len(dataset)) if dataset.mixed.domain(i)):
        sample = dataset[position]
        scan = source[int(dataset.mixed.plan().index[position])]
        assert len(sample) == 15 and sample[14] == len(scan) and scan.label is not None
        labels = sample[3][: len(scan)].numpy()
        assert np.array_equal(
            labels, np.where(scan.label == 255, 0, scan.label.astype(int) + 1)
        )
        assert np.array_equal(sample[11][: len(scan)].numpy(), scan.points)
        assert np.array_equal(sample[13][: len(scan)].numpy(), scan.reflectance)
        assert {0, 9, 13, 1} >= set(np.unique(sample[2])) and (
            sample[2][sample[1] == 0] == 0
        ).all()


def test_nothing_is_left_in_memory(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lidar_synth.integrations.rangenet._MEMORY", str(tmp_path))
    dataset = parser(made).train_dataset
    for position in range(len(dataset)):
        dataset[position]
    assert not list(tmp_path.iterdir())


def test_a_class_map_that_does_not_fit_is_refused(made: Path) -> None:
    merged = {**data()["learning_map"], 10: 4}
    with pytest.raises(ConfigError, match="classes .10. do not come back"):
        parser(made, learning_map=merged)


def test_scans_that_do_not_fit_are_refused_not_cut(made: Path) -> None:
    dataset = parser(made).train_dataset
    dataset.max_points = 10
    with pytest.raises(ConfigError, match="max_points: 10 for a synthetic scan"):
        dataset[next(i for i in range(len(dataset)) if dataset.mixed.domain(i))]


def test_unlabelled_scans_are_refused(made: Path, tmp_path: Path) -> None:
    bare = synthetic(tmp_path / "bare", 3, labels=False)
    for settings in (
        {"synthetic": str(bare)},
        {"synthetic": str(bare), "labels": "none"},
    ):
        (tmp_path / "mix.yaml").write_text(yaml.safe_dump(settings))
        with pytest.raises(ConfigError, match="labels"):
            (tmp_path / "sk").exists() or (tmp_path / "sk").symlink_to(made / "sk")
            parser(tmp_path)


def test_a_parser_of_another_trainer_is_refused() -> None:
    with pytest.raises(
        LibraryError, match=r"without \['Parser', 'SemanticKitti', 'LaserScan'\]"
    ):
        make_parser(ModuleType("parserModule"), {"synthetic": "bank"})


@pytest.fixture(scope="module")
def dense(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Real scans of twice the columns of the synthetic ones."""
    root = tmp_path_factory.mktemp("dense")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("streets.SENSOR", replace(SENSOR, columns=2 * SENSOR.columns))
        semantic_kitti(root / "sk", REAL)
    synthetic(root / "synthetic", 11)
    (root / "mix.yaml").write_text(
        yaml.safe_dump({"synthetic": str(root / "synthetic"), "ratio": 0.4, "seed": 3})
    )
    return root


def sensor_of(width: int) -> Any:
    return arguments(Path())["sensor"] | {
        "img_prop": {"width": width, "height": SENSOR.rows}
    }


def test_a_width_with_stripes_is_refused(made: Path, dense: Path) -> None:
    """At 512 columns a synthetic scan of 256 fills every second one; a real scan of 512 fills
    all. It is refused before the first epoch, also if that has real scans alone."""
    options = arguments(dense, sensor=sensor_of(2 * SENSOR.columns))
    for ratio in (0.4, {0: 0.0, 3: 0.4}):
        settings = {"synthetic": dense / "synthetic", "ratio": ratio}
        with pytest.raises(
            ConfigError,
            match=rf"empty cell to the right.*img_prop.width: {SENSOR.columns} in",
        ):
            make_parser(stock, settings)(**options)
    parser(dense)  # both kinds in images of the synthetic scans' width
    # Stripes in both kinds do not tell them apart.
    parser(made, sensor=sensor_of(2 * SENSOR.columns))


@pytest.fixture
def labelled_scans() -> Path:
    if not os.environ.get("LIDAR_SYNTH_LABELLED_SCANS"):
        pytest.skip("LIDAR_SYNTH_LABELLED_SCANS is not set")
    return Path(os.environ["LIDAR_SYNTH_LABELLED_SCANS"])


DENSITY = {2048: ((0.75, 0.05), (0.75, 0.03)), 1024: ((0.78, 0.02), (0.78, 0.02))}
"""By width: the share of filled cells and of empty right neighbours, in real images and in those of
the model."""


@pytest.mark.slow
def test_density_of_the_shipped_model_and_of_real_scans(
    made: Path, labelled_scans: Path
) -> None:
    """Both kinds are alike at the stock 64 x 2048 and at 1,024 columns."""
    dataset = parser(made).train_dataset
    dataset.sensor_img_H = 64
    paths = sorted(
        labelled_scans.glob("semantic_kitti/sequences/*/velodyne/000000.bin")
    )
    generated = Generated(load_generator("town"))[0]
    found = {}
    for width in DENSITY:
        kinds = (
            [dataset.image(str(path), width) for path in paths],
            [dataset.image(generated, width)],
        )
        found[width] = [
            (float(np.mean([*map(filled, k)])), float(np.mean([*map(gaps, k)])))
            for k in kinds
        ]
        print(
            f"64 x {width}: filled and gaps of real scans {found[width][0]}, of synthetic ones "
            f"{found[width][1]}"
        )
    for width, expected in DENSITY.items():
        assert np.allclose(found[width], expected, atol=0.08), found


def configure(made: Path, out: Path, epochs: int, **sensor: int) -> list[str | Path]:
    """Arguments of ``train.py``: the stock configuration with a small image, and few iterations."""
    source = next(ROOT.rglob(ARCH))
    arch = yaml.safe_load(source.read_text())
    labels = data()
    arch["train"] |= {
        "max_epochs": epochs,
        "batch_size": BATCH,
        "workers": 0,
        "report_batch": 1,
    }
    arch["dataset"]["sensor"]["img_prop"] = {
        "width": SENSOR.columns // 4,
        "height": SENSOR.rows,
    } | sensor
    labels["split"] = {"train": [0], "valid": [0], "test": []}
    for name, content in {"arch": arch, "labels": labels}.items():
        (out / f"{name}.yaml").write_text(yaml.safe_dump(content))
    files = ["-ac", out / "arch.yaml", "-dc", out / "labels.yaml", "-l", out / "log"]
    own = ["-n", "mixed"] if CENET else ["-p", ""] if SALSA else []
    return ["train.py", "-d", made / "sk", *files, *own]


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_its_own_script_trains_from_our_launcher(made: Path, tmp_path: Path) -> None:
    """``train.py`` as a user types it, with validation; SalsaNext resumes, and sees the samples of
    its epoch."""
    cwd = clone(ROOT, tmp_path / "clone") / ("" if CENET else "train/tasks/semantic")
    first = 1 if SALSA else 2
    arguments = configure(made, tmp_path, first)
    said = launched("rangenet", *arguments, cwd=cwd, mixture=made / "mix.yaml")
    if SALSA:
        (log,) = (tmp_path / "log/logs").iterdir()
        said += launched(
            "rangenet",
            *configure(made, tmp_path, 2),
            "-p",
            log,
            cwd=cwd,
            mixture=made / "mix.yaml",
        )
    plans = {e: parser(made).train_dataset.mixed.plan(e).hash[:16] for e in (0, 1)}
    seen = [line for line in epochs(said) if line[0] == 1][:1] + [
        line for line in epochs(said) if line[0] == 0
    ][:1]
    assert seen == [(e, REAL + EXTRA, EXTRA, plans[e]) for e in (1, 0)]
    losses = [
        float(value)
        for value in re.findall(r"Epoch: \[\d+\]\[\d+/5\].*?Loss (\S+)", said)
    ]
    assert len(losses) == 10 and np.isfinite(losses).all()
    assert said.count("Validation set:") == 2 and "IoU class 1 [car]" in said
    weights = "SENet*" if CENET else "SalsaNext" if SALSA else "segmentation_head*"
    assert [*tmp_path.rglob(weights)] and [*tmp_path.rglob("events.out*")]


@pytest.mark.slow
def test_the_launcher_refuses_before_training(dense: Path, tmp_path: Path) -> None:
    cwd = clone(ROOT, tmp_path / "clone") / ("" if CENET else "train/tasks/semantic")
    arguments = configure(dense, tmp_path, 1, width=2 * SENSOR.columns)
    said = launched(
        "rangenet", *arguments, cwd=cwd, mixture=dense / "mix.yaml", status=1
    )
    assert (
        "lidar_synth: synthetic scans in images of 32 x 512" in said
        and "Traceback" not in said
    )
