"""Early stopping: the loss on scans that are not trained on, always of the same samples with the
same noise."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import torch

from lidar_synth.errors import DataError
from lidar_synth.files.disk import read_text, write_file
from lidar_synth.files.parsing import parse_json
from lidar_synth.generate.flow.path import METRICS
from lidar_synth.lab.train.config import Run
from lidar_synth.lab.train.data import Batches
from lidar_synth.lab.train.loop import weigh_metric
from lidar_synth.lab.train.plan import TrainingPlan, open_data
from lidar_synth.lab.train.schedules import ENDLESS, PLATEAU
from lidar_synth.lab.train.state import Training

if TYPE_CHECKING:
    from accelerate import Accelerator

HISTORY = "held_out.json"
"""The file of all measurements in a run's folder."""


class Measured(NamedTuple):
    """One measurement.

    Args:
        step: of the training.
        loss: mean over the samples.
        seconds: of all training up to here, interruptions left out.
    """

    step: int
    loss: float
    seconds: float


def read_history(folder: Path) -> list[Measured]:
    """The measurements of the run in a folder, in order; none if there is no file.

    Raises:
        DataError: on a damaged file.
    """
    path = folder / HISTORY
    if not path.is_file():
        return []
    values = parse_json(read_text(path), str(path))
    try:
        return [
            Measured(int(step), float(loss), float(seconds))
            for step, loss, seconds in values
        ]
    except (TypeError, ValueError) as error:
        raise DataError(
            f"{path} is damaged ({error})", "steps, losses and seconds", "Remove it."
        ) from error


@dataclass
class Watch:
    """Measures the loss of a run on held-out scans, and knows when it stops falling.

    Args:
        config: of the run.
        plan: of the run.
        data: the held-out batches.
        accelerator: of the run.
        measured: measurements up to now.
    """

    config: Run
    plan: TrainingPlan
    data: Batches
    accelerator: "Accelerator"
    measured: list[Measured] = field(default_factory=list)

    @property
    def least(self) -> float:
        """The least loss up to now."""
        return min(m.loss for m in self.measured)

    @property
    def exhausted(self) -> bool:
        """Whether the loss has not fallen for as many measurements as the run has patience. Those
        before the learning rate begins to fall do not count where a plateau ended, or the rate
        would never fall."""
        assert self.config.held_out is not None
        recipe = self.config.recipe
        begin = (
            PLATEAU * recipe.iterations
            if recipe.schedule == "trapezoid" and recipe.iterations < ENDLESS
            else 0
        )
        losses = [m.loss for m in self.measured if m.step >= begin]
        return (
            bool(losses)
            and len(losses) - 1 - losses.index(min(losses))
            >= self.config.held_out.patience
        )

    def measure(self, training: Training) -> bool:
        """Measure the averaged weights, write the history, and return whether they are the best up
        to now."""
        if self.measured and self.measured[-1].step == training.step:
            return self.measured[-1].loss == self.least
        loss = self._loss(training)
        best = not self.measured or loss < self.least
        self.measured.append(Measured(training.step, loss, training.seconds))
        write_file(self.config.output / HISTORY, json.dumps(self.measured).encode())
        return best

    @torch.no_grad()
    def _loss(self, training: Training) -> float:
        assert self.config.held_out is not None
        recipe = training.recipe
        metric = weigh_metric(METRICS[recipe.metric], recipe.weights, self.data.tensors)
        total = 0.0
        count = self.config.held_out.samples
        for start in range(0, count, recipe.batch):
            positions = range(start, min(start + recipe.batch, count))
            with self.accelerator.autocast():
                example = self.plan.task(self.data(positions))
                loss = self.plan.loss(training.average, example, metric)
            total += float(loss) * len(positions)
        return total / count


def open_watch(
    config: Run, plan: TrainingPlan, training: Training, accelerator: "Accelerator"
) -> Watch:
    """The watch of a run, which continues the history in its folder.

    Raises:
        DataError: on a damaged history.
    """
    assert config.held_out is not None
    # What was measured after the last saved state is measured again.
    known = [m for m in read_history(config.output) if m.step <= training.step]
    data = open_data(config, plan, accelerator.device, config.held_out.data, "held_out")
    return Watch(config, plan, data, accelerator, known)
