"""Wrapping a trainer's dataset: a synthetic sample without the form of the real ones is refused at
construction."""

import logging
import random
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch
from mixtures import Endless, Scans
from torch.utils.data import default_collate

from lidar_synth.datasets.classes import IGNORE
from lidar_synth.errors import ConfigError
from lidar_synth.generate.generator import Generated
from lidar_synth.geometry.scan import POINT_FIELDS, Scan
from lidar_synth.geometry.sensor import presets
from lidar_synth.mixing import MixedScans
from lidar_synth.mixing.compare import make_up_scan


class Theirs:
    """A trainer's dataset: each sample is made of the same arrays, points and labels cut to a
    length of its own."""

    def __init__(
        self,
        form: Callable[[np.ndarray, np.ndarray], Any],
        ignored: int = -1,
        first_ignored: int = 0,
    ) -> None:
        self.form = form
        self.ignored = ignored
        self.first_ignored = first_ignored
        self.asked: list[int] = []

    def __len__(self) -> int:
        return 6

    def __getitem__(self, index: int) -> Any:
        self.asked.append(index)
        rng = np.random.default_rng(index)
        label = rng.integers(0, 19, 12)
        if index >= self.first_ignored:
            label[:3] = self.ignored
        # Trainers draw from global generators.
        random.random(), np.random.rand(), torch.rand(1)  # noqa: NPY002
        return self.form(rng.random((12, 4), np.float32), label)


@dataclass
class Sample:
    """As detection trainers have them: an object in a dict."""

    gt_seg: Any
    metainfo: dict[str, str]


FORMS: dict[str, Callable[[np.ndarray, np.ndarray], Any]] = {
    "dict": lambda points, label: {
        "coord": points[:, :3],
        "feat": points,
        "segment": label,
        "name": "x",
    },
    "tensors": lambda points, label: {
        "points": torch.from_numpy(points),
        "label": torch.from_numpy(label),
    },
    "tuple": lambda points, label: (points, label, "x"),
    "list": lambda points, label: [points, label],
    "no box": lambda points, label: {
        "points": points,
        "corners": np.zeros((0, 8, 3), np.float32),
        "label": label,
    },
    "nested": lambda points, label: {
        "inputs": {"points": points},
        "data_samples": Sample(label, {"path": "x"}),
    },
    "image": lambda points, label: {
        "image": np.zeros((3, 4, 6), np.uint8),
        "sem": label.reshape(3, -1),
    },
}


def as_sample(form: Callable[..., Any], ignored: int = -1) -> Callable[..., Any]:
    """The same form from a scan."""

    def to_sample(scan: Scan, rng: np.random.Generator) -> Any:
        points = np.column_stack([scan.points, scan.reflectance]).astype(np.float32)[
            :12
        ]
        assert scan.label is not None
        label = scan.label[:12].astype(np.int64)
        label[:2] = IGNORE
        return form(points, np.where(label == IGNORE, ignored, label))

    return to_sample


@pytest.mark.parametrize("name", FORMS)
def test_samples_of_the_same_form_are_accepted(name: str) -> None:
    train = MixedScans.wrap(
        Theirs(FORMS[name]), Endless(), 0.5, to_sample=as_sample(FORMS[name])
    )
    assert len(train) == 12


def test_a_missing_label_would_cost_the_real_samples_theirs() -> None:
    """What torch makes of such a batch, and that it does not come to it."""
    form = FORMS["dict"]

    def without(p: Any, s: Any) -> dict[str, Any]:
        return {"coord": p[:, :3], "feat": p, "name": "x"}

    options = {"to_sample": as_sample(without), "seed": 2}
    mixed = MixedScans.wrap(Theirs(form), Endless(), 0.5, compare=False, **options)
    samples = sorted(
        (mixed[i] for i in range(len(mixed))), key=lambda s: "segment" in s
    )
    assert "segment" in samples[-1] and "segment" not in default_collate(
        [samples[0], samples[-1]]
    )
    with pytest.raises(
        ConfigError, match=r"sample has no 'segment'.*to_sample.*compare=False"
    ):
        MixedScans.wrap(Theirs(form), Endless(), 0.5, **options)


WRONG: dict[str, tuple[str, Callable[..., Any], str]] = {
    "another key": (
        "dict",
        lambda p, s: FORMS["dict"](p, s) | {"extra": 1},
        "an additional 'extra'",
    ),
    "dtype": (
        "dict",
        lambda p, s: FORMS["dict"](p.astype(np.float64), s),
        r"\['coord'\] is an array of float64",
    ),
    "rank": (
        "dict",
        lambda p, s: FORMS["dict"](p, s[:, None]),
        r"\['segment'\] is an array of int64, rank 2 instead",
    ),
    "library": (
        "dict",
        lambda p, s: FORMS["dict"](p, torch.from_numpy(s)),
        "a tensor of int64, rank 1 instead",
    ),
    "tuple's dtype": (
        "tuple",
        lambda p, s: (p, s.astype(np.int32), "x"),
        r"sample\[1\] is an array of int32",
    ),
    "tuple's length": ("tuple", lambda p, s: (p, s), "2 parts instead of 3"),
    "kind of text": (
        "tuple",
        lambda p, s: (p, s, 7),
        r"sample\[2\] is an integer instead of text",
    ),
    "another container": (
        "dict",
        lambda p, s: (p, s),
        "sample is a sequence instead of a mapping",
    ),
    "in an object": (
        "nested",
        lambda p, s: FORMS["nested"](p, s.astype(np.uint8)),
        r"\.gt_seg is an array",
    ),
    "another object": (
        "nested",
        lambda p, s: {"inputs": {"points": p}, "data_samples": s},
        "instead of an object",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_another_form_is_refused(case: str) -> None:
    name, form, message = WRONG[case]
    with pytest.raises(ConfigError, match=message):
        MixedScans.wrap(Theirs(FORMS[name]), Endless(), 0.5, to_sample=as_sample(form))


@pytest.mark.parametrize("name", FORMS)
@pytest.mark.parametrize(
    ("theirs", "ours"), [(-1, 255), (255, -1), (255, 254), (-100, 255)]
)
def test_another_value_for_ignored_labels_is_refused(
    name: str, theirs: int, ours: int
) -> None:
    with pytest.raises(
        ConfigError,
        match=f"holds {ours}, which no real sample does .*one value for ignored labels",
    ):
        MixedScans.wrap(
            Theirs(FORMS[name], theirs),
            Endless(),
            0.5,
            to_sample=as_sample(FORMS[name], ours),
        )


def test_real_samples_without_an_ignored_label_tell_nothing_yet() -> None:
    theirs = Theirs(FORMS["dict"], first_ignored=3)
    MixedScans.wrap(theirs, Endless(), 0.5, to_sample=as_sample(FORMS["dict"]))
    assert theirs.asked == [0, 1, 2, 3, 4, 5]


def test_comparing_leaves_everything_as_it_was() -> None:
    theirs = Theirs(FORMS["dict"])
    random.seed(1), np.random.seed(1), torch.manual_seed(1)  # noqa: NPY002
    expected = random.random(), np.random.rand(), torch.rand(1)  # noqa: NPY002
    random.seed(1), np.random.seed(1), torch.manual_seed(1)  # noqa: NPY002
    train = MixedScans.wrap(
        theirs, Endless(), 0.5, to_sample=as_sample(FORMS["dict"]), seed=4
    )
    assert (random.random(), np.random.rand(), torch.rand(1)) == expected  # noqa: NPY002
    assert theirs.asked == [0] and train.epoch == 0
    plain = MixedScans.wrap(
        theirs,
        Endless(),
        0.5,
        to_sample=as_sample(FORMS["dict"]),
        seed=4,
        compare=False,
    )
    assert theirs.asked == [0]
    assert all(
        np.array_equal(train[i]["segment"], plain[i]["segment"])
        for i in range(len(train))
    )


class Ahead(Endless):
    """A source that works ahead in another process."""

    def __getitem__(self, number: int) -> Scan:
        raise AssertionError("asked for a scan before training")

    def expect(self, numbers: list[int]) -> None:
        """Nothing: there is no process."""


class Slow(Generated):
    """A model that takes long."""

    sensor, fields, identity = (
        Endless.sensor,
        frozenset({"reflectance", "label"}),
        "slow",
    )  # type: ignore[assignment]

    def __init__(self) -> None:
        pass

    def __getitem__(self, number: int) -> Scan:
        raise AssertionError("asked for a scan before training")


@pytest.mark.parametrize("kind", [Ahead, Slow])
def test_sources_on_demand_are_compared_by_a_made_up_scan(kind: type) -> None:
    MixedScans.wrap(
        Theirs(FORMS["dict"]), kind(), 0.5, to_sample=as_sample(FORMS["dict"])
    )
    with pytest.raises(ConfigError, match="no 'segment'"):
        MixedScans.wrap(
            Theirs(FORMS["dict"]),
            kind(),
            0.5,
            to_sample=as_sample(lambda p, s: {"coord": p, "feat": p}),
        )
    with pytest.raises(ConfigError, match="holds 255"):
        MixedScans.wrap(
            Theirs(FORMS["dict"]), kind(), 0.5, to_sample=as_sample(FORMS["dict"], 255)
        )


@pytest.mark.parametrize("first", [None, ValueError("a damaged file")])
def test_a_first_sample_that_cannot_be_had_stops_nothing(
    first: Any, caplog: pytest.LogCaptureFixture
) -> None:
    def form(points: np.ndarray, label: np.ndarray) -> Any:
        if first is None:
            return None  # as datasets do whose collate function leaves such samples out
        raise first

    with caplog.at_level(logging.WARNING):
        MixedScans.wrap(
            Theirs(form), Endless(), 0.5, to_sample=as_sample(FORMS["dict"])
        )
    assert ("a damaged file" in caplog.text) == (first is not None)


def test_without_real_or_synthetic_samples_there_is_nothing_to_compare() -> None:
    MixedScans.wrap(Theirs(FORMS["dict"]), None, 0, to_sample=as_sample(FORMS["tuple"]))
    MixedScans.wrap(
        None, Endless(), 1, to_sample=as_sample(FORMS["tuple"]), epoch_size=3
    )


@pytest.mark.parametrize("name", ["hdl64e_kitti360", "hdl32e_nuscenes", "os1_128"])
def test_a_made_up_scan_has_the_fields_of_its_source(name: str) -> None:
    sensor = presets()[name]
    scan = make_up_scan(sensor, frozenset(POINT_FIELDS))
    assert set(scan.fields()) == set(POINT_FIELDS) and len(scan) == np.prod(
        sensor.shape
    )
    assert set(np.unique(scan.label)) == {*range(19), IGNORE}
    assert set(make_up_scan(sensor, frozenset({"label"})).fields()) == {
        "reflectance",
        "label",
    }


@pytest.mark.parametrize("name", ["dict", "tuple"])
def test_raw_words_beside_classes_are_named(name: str) -> None:
    def raw(points: np.ndarray, label: np.ndarray) -> Any:
        points = np.tile(points, (10, 1))
        words = np.tile(label, 10) + (np.arange(len(points)) << 16)
        return FORMS[name](points, words)

    with pytest.raises(ConfigError, match="different values instead of.*0xFFFF"):
        MixedScans.wrap(
            Theirs(raw, ignored=0), Endless(), 0.5, to_sample=as_sample(FORMS[name], 0)
        )


@pytest.mark.parametrize(
    "options", [{"loss_weight": 0.1}, {"loss_weight": {0: 1.0, 5: 0.1}}]
)
def test_a_weight_without_a_place_in_the_samples_is_refused(
    options: dict[str, Any],
) -> None:
    def weighed(points: np.ndarray, label: np.ndarray) -> Any:
        return FORMS["dict"](points, label) | {"loss_weight": 1.0}

    for form in (FORMS["dict"], FORMS["tuple"]):
        wrapped: dict[str, Any] = {"to_sample": as_sample(form)}
        with pytest.raises(ConfigError, match="loss_weight for samples without"):
            MixedScans.wrap(Theirs(form), Endless(), 0.5, **wrapped, **options)
        with pytest.raises(ConfigError, match="loss_weight for samples without"):
            list(MixedScans(Scans("r", 2), Endless(), 0.5, **wrapped, **options))
        MixedScans.wrap(Theirs(form), Endless(), 0.5, **wrapped, loss_weight=1)
        wrapped["compare"] = False
        MixedScans.wrap(Theirs(form), Endless(), 0.5, **wrapped, **options)
    list(
        MixedScans.wrap(
            Theirs(weighed), Endless(), 0.5, to_sample=as_sample(weighed), **options
        )
    )


def test_real_samples_of_a_trainer_are_not_augmented() -> None:
    form = FORMS["dict"]
    with pytest.raises(ConfigError, match="augment_real=True with wrap"):
        MixedScans.wrap(
            Theirs(form), Endless(), 0.5, to_sample=as_sample(form), augment_real=True
        )
