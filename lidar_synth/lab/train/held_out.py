"""Early stopping: the loss on scans that are not trained on, always of the same samples with the
same noise."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import torch

from lidar_synth.errors import parsing
from lidar_synth.files.disk import read_text, write_file
from lidar_synth.files.parsing import parse_json
from lidar_synth.generate.flow.path import METRICS
from lidar_synth.lab.train.config import HeldOut
from lidar_synth.lab.train.data import Batches
from lidar_synth.lab.train.loop import weigh_metric
from lidar_synth.lab.train.schedules import ENDLESS, PLATEAU
from lidar_synth.lab.train.stage import Stage
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
    with parsing(path, "steps, losses and seconds", "Remove it."):
        return [
            Measured(int(step), float(loss), float(seconds))
            for step, loss, seconds in values
        ]


class Watch:
    """Measures the loss of a run on held-out scans, and knows when it stops falling.

    Args:
        stage: the training.
        held_out: how the scans are used.
        data: the scans.
        training: its state; what was measured after it was saved is measured again.
        accelerator: of the run.

    Raises:
        DataError: on a damaged history in the folder of the run.
    """

    def __init__(
        self,
        stage: Stage,
        held_out: HeldOut,
        data: Batches,
        training: Training,
        accelerator: "Accelerator",
    ) -> None:
        self.stage = stage
        self.held_out = held_out
        self.accelerator = accelerator
        self.folder = stage.config.output
        history = read_history(self.folder)
        self.measured = [m for m in history if m.step <= training.step]
        self.data = data

    @property
    def least(self) -> float:
        """The least loss up to now."""
        return min(m.loss for m in self.measured)

    @property
    def exhausted(self) -> bool:
        """Whether the loss has not fallen for as many measurements as the run has patience. Those
        before the learning rate begins to fall do not count where a plateau ended, or the rate
        would never fall."""
        recipe = self.stage.config.recipe
        begin = 0.0
        if recipe.schedule == "trapezoid" and recipe.iterations < ENDLESS:
            begin = PLATEAU * recipe.iterations
        losses = [m.loss for m in self.measured if m.step >= begin]
        if not losses:
            return False
        since = len(losses) - 1 - losses.index(min(losses))
        return since >= self.held_out.patience

    def is_best(self, training: Training) -> bool:
        """Whether the averaged weights were measured, and are the best."""
        last = self.measured[-1] if self.measured else None
        return last is not None and last[:2] == (training.step, self.least)

    def measure(self, training: Training) -> bool:
        """Measure the averaged weights, write the history, and return whether they are the best up
        to now."""
        if self.measured and self.measured[-1].step == training.step:
            return self.is_best(training)
        loss = self._loss(training)
        best = not self.measured or loss < self.least
        self.measured.append(Measured(training.step, loss, training.seconds))
        write_file(self.folder / HISTORY, json.dumps(self.measured).encode())
        return best

    @torch.no_grad()
    def _loss(self, training: Training) -> float:
        recipe = training.recipe
        metric = weigh_metric(METRICS[recipe.metric], recipe.weights, self.data.tensors)
        total = 0.0
        count = self.held_out.samples
        for start in range(0, count, recipe.batch):
            positions = range(start, min(start + recipe.batch, count))
            with self.accelerator.autocast():
                example = self.stage.task(self.data(positions))
                loss = self.stage.loss(training.average, example, metric)
            total += float(loss) * len(positions)
        return total / count
