"""Training: data that follow from their position, schedules, the state through a kill, the loop."""

import math
import os
import tracemalloc
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from accelerate import Accelerator
from conftest import random_scan
from hypothesis import given
from torch import Tensor, nn
from torch.utils.data import ConcatDataset

from lidar_synth.errors import ConfigError, DataError, FileError
from lidar_synth.files.parsing import read_sealed, seal
from lidar_synth.formats import WRITERS, open_scans
from lidar_synth.generate.flow.distill import STRATEGIES
from lidar_synth.generate.flow.path import METRICS, Example
from lidar_synth.generate.flow.solvers import uniform_grid
from lidar_synth.generate.models import build_network
from lidar_synth.geometry.normalize import NORMALISATIONS, TensorFormat
from lidar_synth.geometry.projection import project
from lidar_synth.geometry.scan import Scan
from lidar_synth.geometry.sensor import Sensor
from lidar_synth.lab.train import (
    OPTIMIZERS,
    SCHEDULES,
    Batch,
    Batches,
    Conditioning,
    Recipe,
    Training,
    cache_scans,
    loop,
    micro_batches,
    steps,
    student_task,
    teacher_task,
)
from lidar_synth.lab.train.arrays import NOTE
from lidar_synth.lab.train.data import InTurns
from lidar_synth.lab.train.loop import Record, read_figures

SENSOR = Sensor("small", 32, 1.45, 80.0, rows=8, fov_up=3.0, fov_down=-25.0)
TENSORS = TensorFormat(("range", "reflectance", "label"), NORMALISATIONS["r2flow"])
SCANS = [random_scan(SENSOR, 400, seed) for seed in range(5)]


class Convolution(nn.Module):
    """A velocity network that is trained in no time."""

    def __init__(self) -> None:
        super().__init__()
        self.inner = nn.Conv2d(TENSORS.size + 1, 16, 3, padding=1)
        self.outer = nn.Conv2d(16, TENSORS.size, 3, padding=1)

    def forward(self, y: Tensor, t: Tensor, cond: Any = None) -> Tensor:
        time = t.view(-1, 1, 1, 1).expand(-1, 1, *y.shape[2:]).to(y.dtype)
        return self.outer(torch.relu(self.inner(torch.cat((y, time), 1))))


def new_training(**recipe: Any) -> Training:
    torch.manual_seed(0)
    return Training(
        Convolution(),
        Recipe(**{"iterations": 6, "batch": 4, "warmup": 2, "rate": 1e-2} | recipe),
    )


@pytest.fixture(scope="module")
def batches() -> Batches:
    return Batches(
        cache_scans(SCANS, SENSOR, TENSORS.channels, progress=False),
        TENSORS,
        seed=3,
        flip=True,
        roll=True,
    )


@pytest.fixture(scope="module")
def accelerator() -> Accelerator:
    return Accelerator(cpu=True)


# data


def test_a_cache_holds_the_projected_scans_within_its_steps(tmp_path: Path) -> None:
    for folder in (None, tmp_path / "cache"):
        cache = cache_scans(SCANS, SENSOR, TENSORS.channels, folder, progress=False)
        fields = cache.read([4, 0])
        for i, scan in enumerate((SCANS[4], SCANS[0])):
            image = project(scan)
            assert (
                np.abs(fields["range"][i].numpy() - image.range).max()
                <= 80 / 65535 / 2 * 1.01
            )
            assert np.array_equal(fields["range"][i].numpy() > 0, image.mask)
            assert (
                np.abs(
                    fields["reflectance"][i].numpy() - image.channels["reflectance"]
                ).max()
                <= 0.5 / 255 * 1.01
            )
            assert np.array_equal(fields["label"][i].numpy(), image.channels["label"])


class Counted(list[Scan]):
    """A source that counts what is read and stops answering after ``limit`` reads."""

    def __init__(self, scans: list[Scan], limit: int = 10**9) -> None:
        super().__init__(scans)
        self.reads = 0
        self.limit = limit

    def __getitem__(self, index: Any) -> Any:
        if self.reads == self.limit:
            raise KeyboardInterrupt
        self.reads += 1
        return super().__getitem__(index)


def test_a_cache_on_disk_is_found_again_goes_on_and_is_never_that_of_other_data(
    tmp_path: Path,
) -> None:
    scans = [SCANS[i % 5] for i in range(150)]
    broken = Counted(scans, limit=100)
    with pytest.raises(KeyboardInterrupt):
        cache_scans(broken, SENSOR, ["range"], tmp_path, {"town": 150}, progress=False)
    again = Counted(scans)
    cache = cache_scans(
        again, SENSOR, ["range"], tmp_path, {"town": 150}, progress=False
    )
    assert again.reads == 150 - 96  # what was noted as done is kept
    fresh = cache_scans(scans, SENSOR, ["range"], progress=False)
    assert np.array_equal(cache.fields["range"], fresh.fields["range"])
    third = Counted(scans)
    cache_scans(third, SENSOR, ["range"], tmp_path, {"town": 150}, progress=False)
    assert third.reads == 0
    with pytest.raises(
        ConfigError, match=r"cache of other data \(source.town differ\)"
    ):
        cache_scans(scans, SENSOR, ["range"], tmp_path, {"town": 151}, progress=False)
    with pytest.raises(ConfigError, match="channels"):
        cache_scans(
            scans, SENSOR, ["range", "label"], tmp_path, {"town": 150}, progress=False
        )


def test_a_cache_does_not_depend_on_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("ROOT_OF_SCANS", str(tmp_path))
    scans = Counted(SCANS)
    for path, licence in (("a", "x"), ("./a", "y"), ("$ROOT_OF_SCANS/a", "x")):
        told = {"path": path, "licence": licence}
        several = told | {"more": [told]}
        cache_scans(scans, SENSOR, ["range"], Path("kept"), several, progress=False)
    assert scans.reads == len(SCANS)
    with pytest.raises(ConfigError, match=r"data \(source.path, source.more differ"):
        other = {"path": "b", "more": []}
        cache_scans(scans, SENSOR, ["range"], Path("kept"), other, progress=False)


@pytest.mark.parametrize("several", [False, True])
def test_a_cache_of_scans_that_have_changed_is_refused(
    tmp_path: Path, several: bool
) -> None:
    root = tmp_path / "scans"
    writer = WRITERS["semantic_kitti"](root)
    for i, scan in enumerate(SCANS):
        writer.write(scan, i)
    output = root / "runs"  # a run that lies among its scans does not change them

    def cache() -> None:
        opened: Any = open_scans(root)
        source = ConcatDataset([SCANS, opened]) if several else opened
        cache_scans(source, SENSOR, ["range"], output / "cache", progress=False)
        (output / "state.safetensors").write_bytes(bytes(len(list(output.iterdir()))))

    cache()
    cache()
    note = output / "cache" / NOTE
    facts = read_sealed(note, "a note")
    whole = note.read_bytes()
    note.write_bytes(seal({k: v for k, v in facts.items() if k != "files"}))
    cache()  # of an earlier version
    note.write_bytes(whole)
    (root / "image.png").write_bytes(b"added later")
    cache()
    corrected = next(root.rglob("*.label"))
    os.utime(corrected, (0, corrected.stat().st_mtime + 60))  # as large as before
    with pytest.raises(ConfigError, match=r"cache of other data \(files differ\)"):
        cache()


@pytest.mark.slow
def test_processes_make_the_cache_that_one_makes(tmp_path: Path) -> None:
    scans = [SCANS[i % 5] for i in range(40)]
    caches = [
        cache_scans(
            scans, SENSOR, TENSORS.channels, tmp_path / str(jobs), jobs=jobs
        ).fields
        for jobs in (1, 2)
    ]
    for name, values in caches[0].items():
        assert np.array_equal(values, caches[1][name])
    notes = [(tmp_path / str(jobs) / "cache.json").read_bytes() for jobs in (1, 2)]
    assert notes[0] == notes[1]


def test_a_source_that_gives_nothing_or_lacks_a_channel_is_refused() -> None:
    with pytest.raises(DataError, match="without scans"):
        cache_scans([], SENSOR, ["range"])
    bare = Scan(SCANS[0].points, SCANS[0].reflectance, SENSOR)
    with pytest.raises(ConfigError, match=r"has no \['label'\]"):
        cache_scans([bare], SENSOR, ["range", "label"], progress=False)


def test_what_stands_at_a_position_does_not_depend_on_the_others(
    batches: Batches,
) -> None:
    together = batches(range(7, 13))
    for i, position in enumerate(range(7, 13)):
        alone = batches([position])
        assert all(
            torch.equal(a[i], b[0])
            for a, b in zip(together[:3], alone[:3], strict=True)
        )


def moves_of(batches: Batches, count: int) -> list[tuple[bool, int]]:
    """Whether each of the first samples is mirrored, and the columns by which it is turned."""
    plain = replace(batches, flip=False, roll=False)
    found = []
    for i in range(count):
        x = plain([i]).y0
        moved = batches([i]).y0
        [match] = [
            (mirrored, columns)
            for mirrored in (False, True)
            for columns in range(SENSOR.columns)
            if torch.equal(
                (x.flip(-1) if mirrored else x).roll(columns, -1),
                moved,
            )
        ]
        found.append(match)
    return found


def test_samples_are_mirrored_both_ways_and_turned_by_some_degrees(
    batches: Batches,
) -> None:
    """Front to back is left to right, turned round; 45 degrees are 4 of 32 columns."""
    both = moves_of(replace(batches, flip="both", roll=False), 60)
    assert set(both) == {(False, 0), (True, 0), (False, 16), (True, 16)}
    assert min(both.count(move) for move in set(both)) > 5
    turned = moves_of(replace(batches, flip=False, roll=45.0), 60)
    assert {columns for _, columns in turned} == {28, 29, 30, 31, 0, 1, 2, 3, 4}
    assert not any(mirrored for mirrored, _ in turned)


def test_two_sequences_take_turns(batches: Batches) -> None:
    other = replace(batches, seed=4)
    both = InTurns(batches, other)(range(3, 8))
    for i, position in enumerate(range(3, 8)):
        alone = (batches, other)[position % 2]([position // 2])
        assert all(
            torch.equal(a[i], b[0]) for a, b in zip(both[:3], alone[:3], strict=True)
        )
    with pytest.raises(
        ConfigError, match="rehearsal for a model with the condition 'semantic'"
    ):
        InTurns(
            replace(batches, roll=False, conditioning=Conditioning("semantic")), other
        )


@given(epoch=st.integers(0, 50))
def test_every_epoch_is_a_permutation_of_all_scans(
    batches: Batches, epoch: int
) -> None:
    assert sorted(batches.scans_at(range(epoch * 5, epoch * 5 + 5))) == list(range(5))


@pytest.mark.slow
def test_augmentation_turns_and_mirrors_whole_columns(batches: Batches) -> None:
    plain = Batches(batches.cache, TENSORS, seed=3)
    seen = set()
    for position in range(40):
        sample = batches([position]).y0[0]
        original = plain([position]).y0[0]
        found = [
            (flip, shift)
            for flip in (False, True)
            for shift in range(32)
            if torch.equal(
                sample, (original.flip(-1) if flip else original).roll(shift, -1)
            )
        ]
        assert len(found) == 1, position
        seen |= set(found)
    assert {flip for flip, _ in seen} == {False, True}
    assert len(seen) > 20


def test_mirroring_an_image_is_mirroring_its_points() -> None:
    mirrored = Scan(
        SCANS[0].points * np.float32([1, -1, 1]), SCANS[0].reflectance, SENSOR
    )
    assert (
        project(mirrored).range == project(SCANS[0]).range[:, ::-1]
    ).mean() > 0.99  # all but points on an edge


@given(
    step=st.integers(0, 100),
    size=st.integers(1, 4),
    accumulate=st.integers(1, 3),
    processes=st.integers(1, 3),
)
def test_processes_and_micro_batches_share_the_positions_of_a_step(
    step: int, size: int, accumulate: int, processes: int
) -> None:
    batch = size * accumulate * processes
    parts = [
        p
        for r in range(processes)
        for p in micro_batches(step, batch, accumulate, r, processes)
    ]
    assert sorted(i for p in parts for i in p) == list(
        range(step * batch, (step + 1) * batch)
    )
    assert {len(p) for p in parts} == {size}


def test_a_batch_that_cannot_be_divided_is_refused() -> None:
    with pytest.raises(
        ConfigError,
        match=r"recipe.batch=8 with recipe.accumulate=3 in 2 processes; .*recipe.batch=12",
    ):
        list(micro_batches(0, 8, 3, 0, 2))


# schedules


@pytest.mark.parametrize("name", SCHEDULES)
def test_a_schedule_warms_up_and_ends_near_zero(name: str) -> None:
    rate = [SCHEDULES[name](step, 10, 1000) for step in range(1000)]
    assert rate[:10] == pytest.approx([(i + 1) / 10 for i in range(10)])
    assert max(rate) == 1
    assert rate[-1] == 1 if name == "constant" else 0 < rate[-1] < 0.01
    assert all(a >= b for a, b in pairwise(rate[10:]))


def test_the_schedules_have_their_shape() -> None:
    assert SCHEDULES["cosine"](505, 10, 1000) == pytest.approx(0.5)
    assert SCHEDULES["cosine"](257, 10, 1000) == pytest.approx(
        (1 + math.cos(math.pi * 247 / 990)) / 2
    )
    assert [SCHEDULES["trapezoid"](s, 10, 1000) for s in (750, 875)] == [1, 0.5]
    assert [SCHEDULES["trapezoid"](s, 10, 1000) for s in range(750)] == [
        SCHEDULES["trapezoid"](s, 10, 1200) for s in range(750)
    ]


# the loop


@pytest.mark.slow
def test_training_lowers_the_loss(batches: Batches, accelerator: Accelerator) -> None:
    training = new_training(iterations=60, clip=10.0)
    records = list(steps(training, teacher_task(), batches, accelerator))
    assert [r.step for r in records] == list(range(1, 61))
    assert np.mean([r.loss for r in records[-10:]]) < 0.9 * np.mean(
        [r.loss for r in records[:10]]
    )
    assert records[0].rate == pytest.approx(0.5e-2)
    assert all(r.gradient > 0 and r.teacher_evaluations == 0 for r in records)


@pytest.mark.slow
def test_the_first_loss_is_that_of_the_metric_on_the_batch(
    batches: Batches, accelerator: Accelerator
) -> None:
    for metric in METRICS:
        training = new_training(metric=metric)
        batch = batches(range(4))
        y = (1 - batch.u.view(-1, 1, 1, 1)) * batch.y0 + batch.u.view(
            -1, 1, 1, 1
        ) * batch.y1
        expected = METRICS[metric](
            training.network(y, batch.u), batch.y1 - batch.y0
        ).mean()
        record = next(steps(training, teacher_task(), batches, accelerator))
        assert record.loss == pytest.approx(expected.item(), rel=1e-5)


def test_weights_of_channels_are_those_of_their_squared_errors(
    batches: Batches, accelerator: Accelerator
) -> None:
    training = new_training(weights={"range": 4.0, "label": 0.5})
    batch = batches(range(4))
    y = (1 - batch.u.view(-1, 1, 1, 1)) * batch.y0 + batch.u.view(
        -1, 1, 1, 1
    ) * batch.y1
    error = (
        (training.network(y, batch.u) - (batch.y1 - batch.y0)).square().mean((0, 2, 3))
    )
    expected = (error * torch.tensor([4, 1] + [0.5] * 5)).mean()
    assert next(
        steps(training, teacher_task(), batches, accelerator)
    ).loss == pytest.approx(expected.item(), rel=1e-5)


@pytest.mark.slow
def test_accumulation_changes_rounding_only(
    batches: Batches, accelerator: Accelerator
) -> None:
    one, two = (
        [
            r.loss
            for r in steps(
                new_training(accumulate=n), teacher_task(), batches, accelerator
            )
        ]
        for n in (1, 2)
    )
    assert one == pytest.approx(two, rel=1e-4)


def transformer() -> nn.Module:
    """A velocity network that every optimiser can train."""
    torch.manual_seed(0)
    arguments = {
        "width": 16,
        "time_width": 16,
        "depths": [1],
        "heads": [2],
        "patch": [2, 4],
    }
    angles = torch.from_numpy(SENSOR.ray_angles())
    return build_network(
        "hdit",
        {"resolution": SENSOR.shape, "channels": TENSORS.size, "angles": angles}
        | arguments,
    )


@pytest.mark.slow
@pytest.mark.parametrize("optimizer", OPTIMIZERS)
def test_a_saved_run_goes_on_with_the_very_same_losses(
    optimizer: str, batches: Batches, accelerator: Accelerator, tmp_path: Path
) -> None:
    recipe = Recipe(
        iterations=6, batch=4, warmup=2, rate=1e-2, ema_every=1, optimizer=optimizer
    )
    whole = Training(transformer(), recipe)
    losses = [r.loss for r in steps(whole, teacher_task(), batches, accelerator)]
    first = Training(transformer(), recipe)
    for record in steps(first, teacher_task(), batches, accelerator):
        if record.step == 3:
            break
    first.save(tmp_path / "run" / "state.safetensors")
    assert [p.name for p in (tmp_path / "run").iterdir()] == ["state.safetensors"]
    second = Training(transformer(), recipe)
    second.load(tmp_path / "run" / "state.safetensors")
    assert [
        r.loss for r in steps(second, teacher_task(), batches, accelerator)
    ] == losses[3:]
    for a, b in zip(
        whole.average.parameters(), second.average.parameters(), strict=True
    ):
        assert torch.equal(a, b)


@pytest.mark.parametrize("optimizer", OPTIMIZERS)
def test_every_weight_is_moved_once_at_the_rate_of_the_schedule(
    optimizer: str, batches: Batches, accelerator: Accelerator
) -> None:
    recipe = Recipe(iterations=2, batch=4, warmup=4, rate=1e-2, optimizer=optimizer)
    training = Training(transformer(), recipe)
    moved = [
        p
        for o in training.optimizers
        for group in o.param_groups
        for p in group["params"]
    ]
    assert sorted(map(id, moved)) == sorted(map(id, training.network.parameters()))
    record = next(steps(training, teacher_task(), batches, accelerator))
    assert (
        {group["lr"] for o in training.optimizers for group in o.param_groups}
        == {record.rate}
        == {2.5e-3}
    )


def test_the_average_follows_the_weights(
    batches: Batches, accelerator: Accelerator
) -> None:
    training = new_training(iterations=4, ema_every=2, ema_decay=0.5)
    start = [p.clone() for p in training.average.parameters()]
    seen = []
    for _ in steps(training, teacher_task(), batches, accelerator):
        seen.append([p.detach().clone() for p in training.network.parameters()])
    keep = [2 / 11, 3 / 12]  # below the decay: the start is forgotten
    for i, (average, first) in enumerate(
        zip(training.average.parameters(), start, strict=True)
    ):
        expected = first
        for k, weights in zip(keep, (seen[1], seen[3]), strict=True):
            expected = k * expected + (1 - k) * weights[i]
        assert torch.allclose(average, expected, atol=1e-6)


def test_a_loss_that_is_not_finite_stops_and_leaves_the_training_as_it_was(
    batches: Batches, accelerator: Accelerator
) -> None:
    def poisoned(batch: Batch) -> Example:
        example = teacher_task()(batch)
        bad = (
            torch.full_like(example.velocity, torch.nan)
            if training.step == 2
            else example.velocity
        )
        return Example(example.y, example.t, bad)

    training = new_training(ema_every=1)
    run = steps(training, poisoned, batches, accelerator)
    next(run), next(run)
    before = [
        p.clone()
        for p in (*training.network.parameters(), *training.average.parameters())
    ]
    with pytest.raises(DataError, match="step 3: the loss is nan"):
        next(run)
    after = (*training.network.parameters(), *training.average.parameters())
    assert all(torch.equal(a, b) for a, b in zip(before, after, strict=True))
    assert training.step == 2


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_a_student_is_trained_by_every_strategy(
    strategy: str, batches: Batches, accelerator: Accelerator
) -> None:
    teacher = Convolution().eval().requires_grad_(False)
    task = student_task(strategy, teacher, uniform_grid(4), 2)
    records = list(
        steps(new_training(metric="pseudo_huber"), task, batches, accelerator)
    )
    assert all(math.isfinite(r.loss) for r in records)
    # from noise to data, or in one of the 4 intervals
    evaluations = 8 if "piecewise" in strategy else 4 * 8
    assert [r.teacher_evaluations for r in records] == [evaluations] * 6


def test_a_state_that_does_not_fit_is_refused(tmp_path: Path) -> None:
    training = new_training()
    path = tmp_path / "state.safetensors"
    with pytest.raises(FileError, match="cannot be read"):
        training.load(path)
    training.save(path)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(DataError, match="is not a saved state"):
        training.load(path)
    training.save(path)
    other = Training(nn.Linear(2, 2), training.recipe)
    with pytest.raises(DataError, match="state of another network"):
        other.load(path)
    recipe = Recipe(iterations=1, optimizer="muon")
    two = Training(transformer(), recipe)
    for optimizer in two.optimizers:
        for weight in (w for group in optimizer.param_groups for w in group["params"]):
            weight.grad = torch.ones_like(weight)
        optimizer.step()
    two.save(path)
    with pytest.raises(DataError, match="state of another network"):
        Training(transformer(), Recipe(iterations=1)).load(path)


def test_moments_get_the_strides_of_their_weights(tmp_path: Path) -> None:
    """Fused AdamW on a GPU refuses others."""

    def make() -> Training:
        network = nn.Conv2d(3, 4, 3).to(memory_format=torch.channels_last)
        return Training(network, Recipe(iterations=2))

    training = make()
    training.network(torch.ones(1, 3, 5, 5)).sum().backward()
    training.optimizers[0].step()
    training.save(tmp_path / "state.safetensors")
    again = make()
    again.load(tmp_path / "state.safetensors")
    for weight, moments in again.optimizers[0].state.items():
        assert moments["exp_avg"].stride() == weight.stride()
    held = zip(
        training.optimizers[0].state.values(),
        again.optimizers[0].state.values(),
        strict=True,
    )
    for before, after in held:
        assert torch.equal(before["exp_avg_sq"], after["exp_avg_sq"])


def test_a_recipe_with_an_unknown_name_is_refused() -> None:
    with pytest.raises(
        ConfigError,
        match="metric 'l7'; expected one of 'squared_l2', 'pseudo_huber', 'l1'",
    ):
        Recipe(iterations=1, metric="l7")
    with pytest.raises(ConfigError, match="at least 1"):
        Recipe(iterations=0)
    for weights in ({"colour": 1.0}, {"range": 0.0}):
        with pytest.raises(
            ConfigError, match="numbers above 0 for some of range, reflectance, label"
        ):
            Recipe(iterations=1, weights=weights)


def test_a_gpu_is_asked_every_ten_steps_and_stands_still_where_a_step_is_bad(
    batches: Batches, accelerator: Accelerator, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int] = []

    def read(records: Sequence[Record]) -> list[list[float]]:
        asked.append(len(records))
        return read_figures(records)

    monkeypatch.setattr(loop, "steps_between_figures", lambda device: loop.EVERY)
    monkeypatch.setattr(loop, "read_figures", read)
    training = new_training(iterations=24)
    for _ in steps(training, teacher_task(), batches, accelerator):
        pass
    assert asked == [10, 10, 4]

    def poisoned(batch: Batch) -> Example:
        example = teacher_task()(batch)
        bad = torch.nan if training.step >= 2 else 1.0
        return Example(example.y, example.t, example.velocity * bad)

    training = new_training(iterations=24)
    run = steps(training, poisoned, batches, accelerator)
    next(run), next(run)
    before = [p.clone() for p in training.network.parameters()]
    with pytest.raises(DataError, match="step 3: the loss is nan"):
        list(run)
    after = training.network.parameters()
    assert all(torch.equal(a, b) for a, b in zip(before, after, strict=True))


def test_a_state_is_written_from_where_it_lies(tmp_path: Path) -> None:
    training = Training(nn.Linear(1000, 1000), Recipe(iterations=1))
    tracemalloc.start()
    training.save(tmp_path / "state.safetensors")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert (tmp_path / "state.safetensors").stat().st_size > 8e6 > 20 * peak
