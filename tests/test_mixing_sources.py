"""Sources of a mixture: generators, caches, real scans; and the mixtures that are refused."""

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from mixed import Theirs, loader, mixed
from mixtures import Endless, Scans, as_is
from test_generator import SENSOR as GENERATED_SENSOR, write
from torch.utils.data import ConcatDataset, DataLoader, IterableDataset, Subset

from lidar_synth import PolarMix, mix
from lidar_synth.datasets.classes import IGNORE
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.formats import KITTI360, SemanticKITTI
from lidar_synth.generate.generator import Generated, Generator
from lidar_synth.generate.loading import load_generator
from lidar_synth.geometry.scan import SYNTHETIC, identity_of
from lidar_synth.geometry.sensor import Sensor, load_sensor
from lidar_synth.geometry.transfer import Mount, SeenAs, Transfer
from lidar_synth.lab.town import Town
from lidar_synth.mixing import MixedScans, Sources, make_synthetic

pytestmark = pytest.mark.filterwarnings("ignore:This DataLoader will create")


@pytest.fixture(scope="module")
def generator(tmp_path_factory: pytest.TempPathFactory) -> Generator:
    return load_generator(write(tmp_path_factory.mktemp("mixing") / "tiny.safetensors"))


def test_exchanged_arguments_are_named(generator: Generator) -> None:
    with pytest.raises(
        ConfigError,
        match=r"Generator as a source of scans.*Real scans come first",
    ):
        MixedScans(generator, Scans("r", 4, GENERATED_SENSOR), 0.5)


@pytest.mark.slow
def test_the_generator_in_workers_makes_the_same_scans(generator: Generator) -> None:
    real = Scans("r", 4, GENERATED_SENSOR)
    train = MixedScans(real, generator, 0.5, seed=11)
    expected = {
        f"tiny/11/{i}": scan for i, scan in enumerate(generator.scans(11, range(4)))
    }
    for workers in (0, 2):
        items = [
            item
            for batch in DataLoader(train, 2, num_workers=workers, collate_fn=list)
            for item in batch
        ]
        made = [item for item in items if item["domain"]]
        assert sorted(item["id"] for item in made) == sorted(expected)
        for item in made:
            scan = expected[item["id"]]
            assert np.allclose(item["points"][:, :3], scan.points, atol=1e-3)
            assert np.array_equal(item["label"], scan.label)
    assert train.mixture.synthetic[0].identity.startswith(
        f"generated:{generator.hash}:11:"
    )


def test_generators_that_differ_have_different_plans() -> None:
    same = [load_generator("town", **options) for options in ({}, {"columns": 2048})]
    others = [
        load_generator("town", **options)
        for options in ({"columns": 1024}, {"dtype": torch.bfloat16})
    ]
    assert len({Generated(generator).identity for generator in same}) == 1
    assert len({Generated(generator).identity for generator in (*same, *others)}) == 3


def test_sources_that_differ_have_different_plans() -> None:
    """A state of one mixture cannot be loaded into the other."""
    towns = [
        Town(0, scans=50),
        Town(1, scans=50),
        Town(0, scans=50, interval=2.0),
        Town(0, scans=49),
    ]
    transfers = [
        Transfer(load_sensor("vlp16")),
        Transfer(load_sensor("vlp16"), Mount(0.5)),
    ]
    seen = [
        SeenAs(towns[0], transfers[0]),
        SeenAs(towns[1], transfers[0]),
        SeenAs(towns[0], transfers[1]),
        SeenAs(towns[0], transfers[0], seed=1),
    ]
    assert len({identity_of(source) for source in (*towns, *seen)}) == 8
    assert identity_of(Town(0, scans=50)) == identity_of(towns[0])
    assert identity_of(SeenAs(Town(0, scans=50), transfers[0])) == identity_of(seen[0])
    parts: list[Any] = [
        Subset(town, indices)  # type: ignore[arg-type]
        for town in towns[:2]
        for indices in ([0, 1], [0, 2])
    ]
    assert len({identity_of(part) for part in parts}) == 4
    scans = [towns[0][i] for i in range(4)]
    assert identity_of(scans[:2]) != identity_of(scans[2:])
    assert len({identity_of(SeenAs(part, transfers[0])) for part in parts}) == 4
    assert identity_of(Subset(parts[0], [1])) != identity_of(Subset(parts[1], [1]))
    joined = [ConcatDataset([part, parts[0]]) for part in parts]
    assert len({identity_of(one) for one in joined}) == 4
    same: Any = Subset(Town(0, scans=50), range(2))  # type: ignore[arg-type]
    assert identity_of(same) == identity_of(parts[0])
    scans = Scans("a", 3, load_sensor("hdl64e_kitti"))
    scans.ids = ("a", "b", "c")  # type: ignore[attr-defined]
    before = identity_of(SeenAs(scans, transfers[0]))
    scans.ids = ("a", "b", "d")  # type: ignore[attr-defined]
    assert before != identity_of(SeenAs(scans, transfers[0]))


@pytest.mark.slow
def test_a_cache_keeps_the_latest(
    generator: Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[int] = []
    scans = Generator.scans
    monkeypatch.setattr(
        Generator,
        "scans",
        lambda self, seed, n, *a, **k: made.extend(n) or scans(self, seed, n),
    )
    source = Generated(generator, cache=2)
    assert source[0] is source[0]
    [source[i] for i in (1, 0, 2, 0, 1)]
    assert made == [0, 1, 2, 1]
    with pytest.raises(ConfigError, match="cache -1"):
        Generated(generator, cache=-1)
    with pytest.raises(ConfigError, match="option 'stepz'.* Did you mean 'steps'"):
        Generated(generator, stepz=1)


def test_a_conditional_model_takes_its_conditions_in_turn(
    generator: Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(ConfigError, match="conditions for 'tiny'; expected none"):
        Generated(generator, condition=["a map"])
    monkeypatch.setattr(Generator, "condition", "semantic")
    with pytest.raises(ConfigError, match="no conditions for 'tiny'"):
        Generated(generator, condition=[])
    with pytest.raises(
        ConfigError,
        match=r"no conditions for 'tiny'; expected .*\(semantic\).*condition=real",
    ):
        MixedScans(Scans("r", 2, GENERATED_SENSOR), generator)
    calls: list[Any] = []
    monkeypatch.setattr(
        Generator,
        "scans",
        lambda self, *given, **options: calls.append((given, options)) or [None],
    )
    source = Generated(generator, 3, condition=["a", "b"], steps=2)
    [source[n] for n in (0, 3)]
    assert calls == [((3, [0], ["a"]), {"steps": 2}), ((3, [3], ["b"]), {"steps": 2})]
    others = [
        Generated(generator, 3, condition=["a", "b"]),
        Generated(generator, 3, condition=["a"], steps=2),
    ]
    assert len({source.identity, *(other.identity for other in others)}) == 3


def test_a_gpu_in_a_worker_is_refused(
    generator: Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    train = MixedScans(Scans("r", 2, GENERATED_SENSOR), generator, 0.5)
    monkeypatch.setattr(Generator, "device", torch.device("cuda"))
    with pytest.raises(
        ConfigError,
        match=r"inside a DataLoader worker.*\(A\) bake .*\(B\) .*\(C\) mix in",
    ):
        list(loader(train, 1, batch_size=4))


class Ahead(Endless):
    """A source that works ahead."""

    def __init__(self) -> None:
        super().__init__()
        self.epochs: list[int] = []
        self.expected: list[int] = []

    def set_epoch(self, epoch: int) -> None:
        self.epochs.append(epoch)

    def expect(self, numbers: list[int]) -> None:
        self.expected = list(numbers)


def test_upcoming_scans_are_announced_to_a_source_that_works_ahead() -> None:
    source = Ahead()
    train = MixedScans(Scans("r", 6), source, 0.5)

    def asked(positions: range) -> list[int]:
        return [int(train[i]["id"][1:]) for i in positions if train.domain(i)]

    assert (source.epochs, source.expected) == ([0], asked(range(12)))
    train.set_epoch(1)
    assert (source.epochs, source.expected) == ([0, 1], asked(range(12)))
    sampler = train.batches(2, rank=1, world_size=2)
    list(sampler)
    assert source.expected == [
        n for start in (2, 6, 10) for n in asked(range(start, start + 2))
    ]


def test_the_plan_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    train = mixed()
    with caplog.at_level(logging.INFO, "lidar_synth"):
        train.set_epoch(2)
        [train[i] for i in range(4)]
    assert caplog.messages == [
        f"epoch 2: 15 samples, 6 of them synthetic, plan {train.plan().hash[:16]}"
    ]


def test_real_scans_are_untouched(real_scans: Path) -> None:
    reader = SemanticKITTI(real_scans / "semantic_kitti", split="train")
    synth = Scans("s", 3, load_sensor("town"))
    train = MixedScans(reader, synth, 0.25)
    expected = {scan.id: scan for scan in reader}
    seen = set()
    for batch in DataLoader(train, 2, num_workers=2, collate_fn=list):
        for item in batch:
            if item["domain"] == 0:
                scan = expected[item["id"]]
                assert (
                    item["points"].numpy().tobytes()
                    == np.c_[scan.points, scan.reflectance].tobytes()
                )
                assert (
                    item["label"].numpy().astype(np.uint8).tobytes()
                    == scan.label.tobytes()
                )
                seen.add(item["id"])
    assert seen == set(expected)
    pool = MixedScans(KITTI360(real_scans / "kitti360"), synth, 0.5, labels="none")
    batch = next(iter(loader(pool, 0, batch_size=3)))
    assert (batch["label"] == IGNORE).all()
    assert pool.domain(0) == int(batch["domain"][0])


def other_classes() -> Scans:
    scans = Scans("r", 2)
    scans.classes = ("road", "car")  # type: ignore[attr-defined]
    return scans


def wrong_labels(label: int) -> Any:
    scans = Scans("r", 1)
    scans[0].label = np.full(len(scans[0]), label)
    return MixedScans(scans, ratio=0)[0]


class OneByOne(IterableDataset[Any]):
    """A trainer's samples without numbers."""

    def __len__(self) -> int:
        return 5

    def __iter__(self) -> Any:
        return iter(range(5))


def batch_of(sample: Any) -> Any:
    train = MixedScans(Scans("r", 2), ratio=0, to_sample=lambda scan, rng: sample)
    return next(iter(train.loader(2)))


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: mixed(ratio=1.01), ConfigError, r"ratio 1.01"),
        (
            lambda: mixed(ratio=[0.5]).set_epoch(1),
            ConfigError,
            r"epoch 1 of a ratio schedule for 1 epochs",
        ),
        (lambda: mixed(real=0), DataError, r"a source without scans \(Scans:0:"),
        (
            lambda: mixed(labels="gessed"),
            ConfigError,
            r"labels='gessed'; expected one of",
        ),
        (lambda: mixed(collate="voxels"), ConfigError, "form of batches: 'voxels'"),
        (
            lambda: mixed(unlabelled="skip"),
            ConfigError,
            r"unlabelled of batches: 'skip'",
        ),
        (lambda: mixed()[15], IndexError, "scan 15 of 15"),
        (lambda: mixed()[1.5], TypeError, r"scan 1.5; expected a whole number"),
        (lambda: mixed()[:3], TypeError, r"scans\[i\] for i in range\(3\)"),
        (lambda: mixed().domain(99), IndexError, "scan 99 of 15"),
        (lambda: mixed().loss_weight(99), IndexError, "scan 99 of 15"),
        (lambda: Sources(Scans("r", 4))[-5], IndexError, "scan -5 of 4"),
        (lambda: Sources(Scans("r", 4))["0"], TypeError, "scan '0'"),
        (lambda: mixed().batches(0), ConfigError, r"batch_size 0"),
        (lambda: mixed().batches(2, rank=2, world_size=2), ConfigError, r"rank 2 of 2"),
        (lambda: mixed().batches(2, rank=1), ConfigError, r"rank 1 of None"),
        (lambda: mixed().batches(2).state_dict(9), ConfigError, r"9 batches done of 8"),
        (
            lambda: mixed().batches(2).load_state_dict({"epoch": 1}),
            ConfigError,
            r"epoch and position",
        ),
        (
            lambda: (
                mixed()
                .batches(2)
                .load_state_dict({"seed": 1, "epoch": 0, "position": 0, "plan": ""})
            ),
            ConfigError,
            r"a state of another mixture",
        ),
        (
            lambda: MixedScans(Scans("r", 2), Endless(("reflectance",))),
            ConfigError,
            r"only have \['reflectance'\].*'ignore'",
        ),
        (
            lambda: MixedScans(Scans("r", 2, load_sensor("os1_128")), Endless()),
            ConfigError,
            r"'os1_128' \(128 x 1024.*'small' \(8 x 32.*sensor=generator.sensor",
        ),
        (
            lambda: MixedScans(Sources(Scans("r", 2), other_classes()), Endless()),
            ConfigError,
            r"labels mean \('road', 'car'\).*Taxonomy.decode",
        ),
        (
            lambda: MixedScans(Theirs(), Endless()),
            ConfigError,
            r"of the type dict.*MixedScans.wrap",
        ),
        (
            lambda: mix([Scans("r", 2), Scans("t", 2)], Endless()),
            ConfigError,
            r"of the type Scans; expected scans. Sources\(a, b\) joins several",
        ),
        (
            lambda: MixedScans(Scans("r", 2), "town"),
            ConfigError,
            r"str as a source of scans.*load_generator",
        ),
        (
            lambda: MixedScans(Scans("r", 2), labels="ignore"),
            ConfigError,
            r"without a synthetic source",
        ),
        (lambda: Sources(), ConfigError, r"0 sources"),
        (
            lambda: Sources(Scans("r", 1), weights=[1, 2]),
            ConfigError,
            r"1 sources with weights \[1, 2\]",
        ),
        (
            lambda: wrong_labels(40),
            DataError,
            r"labels \[40\]; expected train ids 0..18, or 255",
        ),
        (
            lambda: wrong_labels(-1),
            DataError,
            r"label holds -1.*train ids, 255 = ignore",
        ),
        (
            lambda: MixedScans(None, Endless(), {0: 1.0, 3: 0.5}, epoch_size=4),
            DataError,
            r"no real scans, with ratio 0.5 in epoch 3 and epoch_size=4",
        ),
        (
            lambda: MixedScans(Scans("r", 4), None, {0: 0.0, 10: 0.5}),
            ConfigError,
            r"ratio 0.5 in epoch 10 without a synthetic source",
        ),
        (
            lambda: MixedScans.wrap(OneByOne(), Endless(), to_sample=as_is),
            ConfigError,
            r"OneByOne as a source.*map-style dataset",
        ),
        (lambda: MixedScans(Scans("r", 4), []), DataError, "a source without scans"),
        (lambda: mix(OneByOne(), Endless()), ConfigError, "OneByOne as a source"),
        (
            lambda: mix((s for s in Scans("r", 4)), Endless()),
            ConfigError,
            "generator as a source",
        ),
        (
            lambda: mix(Scans("r", 4), {"path": "bank"}),
            ConfigError,
            "dict as a source",
        ),
        (
            lambda: MixedScans(
                Scans("r", 4),
                Endless(),
                labels=PolarMix(real="folder"),  # type: ignore[arg-type]
            ),
            ConfigError,
            r"str as a source.*open_scans\(path\)",
        ),
        (
            lambda: batch_of({"points": 1}),
            ConfigError,
            r"a sample of the form \['points'\]; expected a dict with boxes,.*collate=",
        ),
        (lambda: batch_of((1, 2)), ConfigError, r"of the form tuple;.*collate="),
    ],
)
def test_invalid_mixtures_are_refused(
    make: Callable[[], object], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        make()


def test_sensors_with_the_same_directions_can_be_mixed() -> None:
    kitti = load_sensor("hdl64e_semantic_kitti")
    far = load_sensor("town")
    assert len(MixedScans(Scans("r", 3, kitti), Scans("s", 2, far), 0.25)) == 4
    other = Sensor("other", 32, 1.45, 80.0, rows=8, fov_up=2.0, fov_down=-25.0)
    with pytest.raises(ConfigError, match=r"'small' .* and 'other'"):
        MixedScans(Scans("r", 3), Scans("s", 2, other), 0.25)


def test_existing_scans_become_synthetic() -> None:
    held = make_synthetic(Scans("h", 2))
    assert (held.length, held[1].domain, held[1].id) == (2, SYNTHETIC, "h1")
    assert "label" in held.fields
