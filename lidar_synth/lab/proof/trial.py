"""One training and its test: an arm, the places that are tested, a seed.

``reference`` trains the package's small range-view segmenter. A trainer of your own is a function
of the same form.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from lidar_synth.datasets.classes import NAMES
from lidar_synth.errors import DataError
from lidar_synth.geometry import Scan, Sensor
from lidar_synth.geometry.arrays import Int64Array
from lidar_synth.geometry.projection import project
from lidar_synth.lab.evaluate.segmentation import Images, confusion
from lidar_synth.lab.evaluate.segmenter import RangeSegmenter, segmenter_input
from lidar_synth.lab.proof.arms import REAL, ArmStage, Row, policy_of
from lidar_synth.lab.train.segmentation import endless_batches, train_segmenter
from lidar_synth.labels.augment import mirror_scan, rotate_scan
from lidar_synth.mixing import MixedScans, settle

LOOKS = 8
"""Points of the curve of a training."""
SETTLING = 16
SETTLING_LOOK = 4
"""Batches of real scans over which the statistics of the normalisation are taken, after a training
and during it."""


@dataclass(frozen=True)
class Job:
    """One training, as a trainer gets it.

    Args:
        row: the arm.
        seed: of the weights, of the order, and of all that is random.
        real: the labelled scans.
        held_out: {place: scans} to test on.
        pools: {name: synthetic scans} of the arm.
        iterations: of the arm.
        batch: samples of an iteration.
        widths: channels of the reference network by level.
        half: whether the reference network computes in bfloat16.
        folder: where a trainer may write files.
        pool_folders: {name: folder} of the pools that files hold as they are, in SemanticKITTI's
            layout.
        device: on which the reference network computes.
    """

    row: Row
    seed: int
    real: Sequence[Scan]
    held_out: Mapping[str, Sequence[Scan]]
    pools: dict[str, list[Scan]]
    iterations: int
    batch: int
    widths: tuple[int, ...]
    half: bool
    folder: Path
    pool_folders: dict[str, Path] = field(default_factory=dict)
    device: str = "cpu"

    @property
    def sensor(self) -> Sensor:
        """The grid of the scans."""
        return self.real[0].sensor

    def stages(self) -> Iterator[tuple[ArmStage, int]]:
        """The stages that have iterations, with their number; all add up to ``iterations``."""
        stages = self.row.stages()
        done = 0
        for number, stage in enumerate(stages):
            last = number + 1 == len(stages)
            count = (
                self.iterations - done if last else round(stage.share * self.iterations)
            )
            done += count
            if count:
                yield stage, count

    def mixtures(self, **options: Any) -> Iterator[tuple[MixedScans, int]]:
        """The training sets of the stages, one after the other, with their iterations.

        Args:
            options: further arguments of ``MixedScans``, such as ``to_sample`` and ``collate``.
        """
        for number, (stage, iterations) in enumerate(self.stages()):
            real = None if stage.ratio == 1 else list(self.real)
            synthetic = None
            labels = None
            if stage.ratio:
                synthetic = (
                    list(self.real) if stage.pool == REAL else self.pools[stage.pool]
                )
                labels = policy_of(
                    stage, list(self.real), frozenset(synthetic[0].fields())
                )
            yield (
                MixedScans(
                    real,
                    synthetic,
                    stage.ratio,
                    labels or "generated",
                    seed=1000 * self.seed + number,
                    epoch_size=iterations * self.batch,
                    balanced=True,
                    augment=turn_scan,
                    augment_real=True,
                    **options,
                ),
                iterations,
            )


@dataclass(frozen=True)
class TrialOutcome:
    """What came of a training on a place.

    Args:
        table: (19, 19) number of returns of the held-out scans by label (row) and prediction
            (column).
        curve: (iterations, table) during the training; empty if the trainer does not tell.
        losses: mean training losses of ten equal parts of the training; empty if the trainer does
            not tell.
        seconds: that the training took.
    """

    table: Int64Array
    curve: list[tuple[int, Int64Array]] = field(default_factory=list)
    losses: list[float] = field(default_factory=list)
    seconds: float = 0.0


Outcome = TrialOutcome | Int64Array
Trainer = Callable[[Job], Mapping[str, Outcome] | Outcome]
"""Trains as a job says and tests on its held-out scans; returns {place: outcome}, or an outcome if
there is one place. An outcome is a ``TrialOutcome``, or its table alone."""


def turn_scan(scan: Scan, rng: np.random.Generator) -> Scan:
    """Turn a scan by a whole number of columns, and mirror it left and right with probability one
    half.

    Returns stay within their cells, so that the range image of a thinned scan loses none.
    """
    columns = scan.sensor.columns
    scan = rotate_scan(scan, 2 * np.pi / columns * int(rng.integers(columns)))
    return mirror_scan(scan, "y") if rng.random() < 0.5 else scan


def run_trainer(trainer: Trainer, job: Job) -> dict[str, TrialOutcome]:
    """Run a trainer, and take its time; returns the outcome of each place.

    Raises:
        DataError: on a table of another shape than (19, 19), or other places than those of the
            job.
    """
    start = time.monotonic()
    result = trainer(job)
    if not isinstance(result, Mapping):
        result = dict.fromkeys(list(job.held_out)[:1], result)
    if set(result) != set(job.held_out):
        raise DataError(
            f"a trainer with results of {', '.join(map(repr, sorted(result)))}",
            f"one of each of {', '.join(map(repr, job.held_out))}",
        )
    seconds = time.monotonic() - start
    return {place: _outcome_of(result[place], seconds) for place in job.held_out}


def _outcome_of(result: Outcome, seconds: float) -> TrialOutcome:
    outcome = result
    if not isinstance(outcome, TrialOutcome):
        outcome = TrialOutcome(np.asarray(outcome, np.int64))
    expected = (len(NAMES), len(NAMES))
    if outcome.table.shape != expected:
        raise DataError(
            f"a trainer that returns a table of shape {outcome.table.shape}",
            f"{expected}",
        )
    return replace(outcome, seconds=seconds)


Tables = dict[str, Int64Array]
"""{place: table}"""


def reference(job: Job) -> dict[str, TrialOutcome]:
    """Train the package's range-view segmenter on the grid of the scans, and test it on the
    held-out scans."""
    network, height = _fresh(job)
    held_out = {name: images(part, job.sensor) for name, part in job.held_out.items()}
    looks = {round(job.iterations * part / LOOKS) for part in range(1, LOOKS)} - {
        job.iterations
    }
    curve: list[tuple[int, Tables]] = []

    def test(batches: int) -> Tables:
        settled = _settled(network, job, height, batches)
        return {
            place: _test(settled, part, height, job.half)
            for place, part in held_out.items()
        }

    def watch(step: int) -> None:
        if step in looks:
            curve.append((step, test(SETTLING_LOOK)))

    losses = train_segmenter(
        network,
        _batches(job),
        height,
        job.iterations,
        progress=False,
        half=job.half,
        watch=watch,
    )
    curve.append((job.iterations, test(SETTLING)))
    parts = [float(np.mean(part)) for part in np.array_split(losses, 10) if len(part)]
    outcomes = {}
    for place in held_out:
        own = [(step, tables[place]) for step, tables in curve]
        outcomes[place] = TrialOutcome(own[-1][1], own, parts)
    return outcomes


def _batches(job: Job) -> Iterator[Images]:
    """The batches of all stages, one after the other."""
    for mixed, count in job.mixtures(collate="range"):
        yield from islice(endless_batches(mixed, job.batch), count)


def _fresh(job: Job) -> tuple[RangeSegmenter, Tensor]:
    """A network that has learnt nothing, and the (H, W) sine of the elevations of the grid."""
    torch.manual_seed(job.seed)
    network = RangeSegmenter(widths=job.widths).to(job.device)
    return network, torch.from_numpy(np.sin(job.sensor.ray_angles()[0])).to(job.device)


def images(scans: Sequence[Scan], sensor: Sensor) -> list[Images]:
    """Batches of one labelled range image each."""
    made: list[Images] = []
    for scan in scans:
        image = project(scan, sensor, ("reflectance", "label"))
        arrays = {
            "range": image.range,
            **{name: image.channels[name] for name in ("reflectance", "label")},
        }
        made.append(
            {name: torch.from_numpy(values[None]) for name, values in arrays.items()}
        )
    return made


def _test(
    network: nn.Module, held_out: Sequence[Images], height: Tensor, half: bool
) -> Int64Array:
    network.eval()
    with torch.autocast(height.device.type, torch.bfloat16, enabled=half):
        return confusion(network, held_out, height)


def _settled(
    network: RangeSegmenter, job: Job, height: Tensor, batches: int
) -> nn.Module:
    """A copy whose statistics of the normalisation are those of the labelled real scans; the same
    in every arm.

    Those of the training are of real and synthetic scans together, and the test has only real ones.
    """
    mixed = MixedScans(
        list(job.real),
        ratio=0,
        seed=job.seed,
        epoch_size=SETTLING * job.batch,
        augment=turn_scan,
        augment_real=True,
        collate="range",
    )
    some = islice(endless_batches(mixed, job.batch), batches)

    def forward(model: nn.Module, batch: Images) -> Any:
        return model(segmenter_input(batch["range"], batch["reflectance"], height))

    with torch.autocast(height.device.type, torch.bfloat16, enabled=job.half):
        return settle(network, some, forward)
