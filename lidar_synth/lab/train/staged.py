"""Training runs one after the other, in folders below one folder, with a limit of time for all of
them.

A run of ``train_for`` keeps its learning rate for three quarters of its time; then the rate falls
to zero over a third of the steps done so far (the schedule "trapezoid").
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from lidar_synth.errors import ConfigError
from lidar_synth.files.disk import write_file
from lidar_synth.lab.train.config import DistillConfig, Run, TrainConfig
from lidar_synth.lab.train.config.load import Config
from lidar_synth.lab.train.resume import read_beginning
from lidar_synth.lab.train.runs import run
from lidar_synth.lab.train.schedules import ENDLESS, PLATEAU
from lidar_synth.lab.train.state import STATE, read_progress

DONE = "done"
"""An empty file in the folder of a run that later ones have started from, or may start from."""


@dataclass(frozen=True)
class StagedRuns:
    """The runs of several stages.

    Args:
        folder: of them all.
        shares: {name of a stage: its share of the limit of time}, in order.
    """

    folder: Path
    shares: Mapping[str, float]

    def folder_of(self, name: str) -> Path:
        """The folder of a stage's run."""
        return self.folder / name

    def checkpoint(self, name: str) -> Path:
        """The checkpoint of a stage."""
        return self.folder / name / f"{name}.safetensors"

    def is_done(self, name: str) -> bool:
        """Whether a stage is done: more steps would change what the next one began with."""
        return (self.folder / name / DONE).is_file()

    def mark_done(self, name: str) -> None:
        """Note that a stage is done."""
        write_file(self.folder / name / DONE, b"")

    def spent(self, name: str) -> float:
        """Minutes that a stage has trained."""
        return read_progress(self.folder_of(name)).seconds / 60

    def budgets(self, limit: float) -> dict[str, float]:
        """Minutes of each stage that is not done, which share what the others have left of a
        ``limit`` for all."""
        open_ = {
            name: share for name, share in self.shares.items() if not self.is_done(name)
        }
        left = limit - sum(
            self.spent(name) for name in self.shares.keys() - open_.keys()
        )
        return {
            name: left * share / sum(open_.values()) for name, share in open_.items()
        }


def iterations_of(config: Run) -> int:
    """The iterations of the run in a folder; ``ENDLESS`` before its rate falls, or if there is
    none."""
    if (config.output / STATE).is_file():
        return read_beginning(config).recipe.iterations
    return ENDLESS


def set_iterations(config: Config, iterations: int) -> Config:
    """The same configuration with other iterations."""
    return config.model_copy(
        update={"recipe": replace(config.recipe, iterations=iterations)}
    )


def train_for(config: TrainConfig | DistillConfig, minutes: float) -> Path:
    """A run with a limit of time in place of iterations; a second call resumes it.

    Args:
        config: of the run, with the schedule "trapezoid".
        minutes: of training in all, those of earlier calls included. The fall of the rate takes a
            quarter of them.

    Returns:
        The checkpoint.

    Raises:
        ConfigError: if the rate would fall before the warm-up ends.
    """
    iterations = iterations_of(config)
    if iterations == ENDLESS:
        left = PLATEAU * minutes - read_progress(config.output).seconds / 60
        if left > 0:
            run(set_iterations(config, ENDLESS), resume=True, minutes=left)
        steps = read_progress(config.output).step
        warmup = config.recipe.warmup
        if steps < warmup:
            raise ConfigError(
                f"{minutes:.3g} minutes for {config.output}, {steps} steps before the learning "
                "rate falls",
                f"enough for its {warmup} steps of warm-up",
                "Type more --minutes, or fewer steps (recipe.warmup=N) with another output=FOLDER.",
            )
        iterations = math.ceil(steps / PLATEAU)
    run(set_iterations(config, iterations), resume=True)
    return config.checkpoint
