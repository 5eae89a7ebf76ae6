# ruff: noqa: E402, NPY001, NPY002 - imports wait for what they need; trainers draw from numpy's global generator
"""RangeNet++'s or SalsaNext's own parser on mixed scans: RANGENET_ROOT is a checkout of lidar-bonnetal or SalsaNext."""

import random
import sys
from collections import Counter
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from checkouts import checkout, stand_in
from streets import semantic_kitti, synthetic

ROOT = checkout("RANGENET_ROOT", "lidar-bonnetal or SalsaNext")
sys.path.append(str(ROOT / "train"))
np.float = float  # type: ignore[attr-defined]  # both are written for numpy before 1.24
stand_in("torchvision")
stand_in("accimage")

from lidar_synth.integrations.rangenet import write_parser
from tasks.semantic.dataset.kitti import parser as stock

from lidar_synth.errors import ConfigError
from lidar_synth.formats import open_scans

REAL, EXTRA, BATCH = 6, 4, 2
SALSA = hasattr(stock, "my_collate")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make(tmp_path_factory.mktemp("rangenet"))


def make(root: Path) -> Path:
    """Real and synthetic scans, and a parser."""
    semantic_kitti(root / "sk", REAL)
    synthetic(root / "synthetic", 11)
    mixture = {"synthetic": str(root / "synthetic"), "ratio": 0.4, "seed": 3}
    (root / "mix.yaml").write_text(yaml.safe_dump(mixture))
    write_parser(root / "mix.yaml", root / "mixed")
    return root


def data() -> dict[str, Any]:
    found = next(ROOT.rglob("config/labels/semantic-kitti.yaml"))
    return yaml.safe_load(found.read_text())  # type: ignore[no-any-return]


def arguments(made: Path, **others: Any) -> dict[str, Any]:
    labels = data()
    sensor = {
        "name": "HDL64", "type": "spherical", "fov_up": 3, "fov_down": -25,
        "img_prop": {"width": 2048, "height": 64},
        "img_means": [12.12, 10.88, 0.23, -1.04, 0.21], "img_stds": [12.32, 11.47, 6.91, 0.86, 0.16],
    }  # fmt: skip
    return {
        "root": str(made / "sk"), "train_sequences": [0], "valid_sequences": [0], "test_sequences": None,
        **{key: labels[key] for key in ("labels", "color_map", "learning_map", "learning_map_inv")},
        "sensor": sensor, "max_points": 20000, "batch_size": BATCH, "workers": 0, "gt": True,
        "shuffle_train": True,
    } | others  # fmt: skip


def parser(made: Path, **others: Any) -> Any:
    """As the trainers load it, by the path of the file."""
    spec = spec_from_file_location("parserModule", made / "mixed" / "parser.py")
    assert spec is not None and spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.Parser(**arguments(made, **others))


def both(made: Path) -> tuple[Any, Any]:
    """The trainer's own training set and ours, of the same real scans; tools/bench/trainers.py times them."""
    keys = ("labels", "color_map", "learning_map", "learning_map_inv", "sensor", "max_points", "gt")
    options = {key: arguments(made)[key] for key in keys} | ({"transform": True} if SALSA else {})
    return stock.SemanticKitti(str(made / "sk"), [0], **options), parser(made).train_dataset


def test_two_epochs_see_exactly_the_planned_scans(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made_parser = parser(made, workers=2)
    loader, seen = made_parser.get_train_set(), []
    assert made_parser.get_train_size() == (REAL + EXTRA) // BATCH
    if SALSA:  # its batches tell no names
        loader.collate_fn = torch.utils.data.default_collate
    for epoch in (0, 1):
        batches = list(loader)
        names = [(s, n) for batch in batches for s, n in zip(batch[4], batch[5], strict=True)]
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
        assert batch[0].shape[1:] == (5, 64, 2048) and batch[2].max() <= 19


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
    dataset, source = parser(made).train_dataset, open_scans(made / "synthetic")
    dataset.transform = False
    for position in (i for i in range(len(dataset)) if dataset.mixed.domain(i)):
        sample, scan = dataset[position], source[int(dataset.mixed.plan().index[position])]
        assert len(sample) == 15 and sample[14] == len(scan) and scan.label is not None
        labels = sample[3][: len(scan)].numpy()
        assert np.array_equal(labels, np.where(scan.label == 255, 0, scan.label.astype(int) + 1))
        assert np.array_equal(sample[11][: len(scan)].numpy(), scan.points)
        assert np.array_equal(sample[13][: len(scan)].numpy(), scan.reflectance)
        assert {0, 9, 13, 1} >= set(np.unique(sample[2])) and (sample[2][sample[1] == 0] == 0).all()


def test_nothing_is_left_in_memory(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
    for settings in ({"synthetic": str(bare)}, {"synthetic": str(bare), "labels": "none"}):
        (tmp_path / "mix.yaml").write_text(yaml.safe_dump(settings))
        write_parser(tmp_path / "mix.yaml", tmp_path / "mixed")
        with pytest.raises(ConfigError, match="labels"):
            (tmp_path / "sk").exists() or (tmp_path / "sk").symlink_to(made / "sk")
            parser(tmp_path)
