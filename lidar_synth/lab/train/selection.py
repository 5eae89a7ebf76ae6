"""The selection of a student's timesteps: a stage of its own before the training.

Its costs are kept in ``selection.npz`` in the run's folder, with the settings that decided them:
others must not pass for these. A selection that was interrupted is continued from there, and ends
with the same timesteps; a complete one is not repeated.
"""

import json
import time
import warnings
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from numpy.typing import NDArray
from tqdm import tqdm

from lidar_synth.errors import ConfigError, DataError, parsing
from lidar_synth.files.disk import write_arrays
from lidar_synth.files.parsing import parse_json, read_arrays
from lidar_synth.generate.checkpoint import Header
from lidar_synth.generate.flow.path import METRICS, Velocity
from lidar_synth.generate.flow.timesteps import Selection, TrajectoryCosts, sum_costs
from lidar_synth.lab.train.config import DistillConfig
from lidar_synth.lab.train.data import Batches
from lidar_synth.lab.train.loop import weigh_metric
from lidar_synth.lab.train.ranks import ALONE, Ranks
from lidar_synth.lab.train.resume import HARMLESS, flatten
from lidar_synth.lab.train.state import checksum_of

SAVE_SECONDS = 10.0
"""Seconds between two saves of a selection under way."""


class TimestepSelection:
    """The timesteps of a student: selected already, in part, or not yet.

    Args:
        config: of the student.
        header: of the student; its provenance holds the hashes of its teachers.

    Attributes:
        done: the costs in the run's folder; None where there are none.

    Raises:
        ConfigError: where the folder holds the timesteps of other settings.
        FileError: where they cannot be read.
    """

    def __init__(self, config: DistillConfig, header: Header) -> None:
        self.config = config
        self.conditional = bool(header.conditioning)
        self.path = config.output / "selection.npz"
        self.settings = selection_settings(config, header)
        self.done: TrajectoryCosts | None = None
        if self.path.exists():
            try:
                self.done = load_costs(self.path, self.settings)
            except DataError as error:
                warnings.warn(
                    f"{error}; the timesteps are selected again", stacklevel=2
                )

    def run(
        self,
        velocity: Velocity,
        shape: tuple[int, ...],
        data: Batches,
        ranks: Ranks = ALONE,
    ) -> Selection:
        """Select the timesteps, as far as they are not; a bar shows the trajectories.

        Args:
            velocity: the teacher.
            shape: of a state.
            data: the training data, whose conditions the trajectories have.
            ranks: the processes that share the trajectories.

        Raises:
            ConfigError, DataError: as ``sum_costs``.
            FileError: where the costs cannot be saved.
        """
        given = self.config.selection
        if self.done is not None and len(self.done.optima) == given.trajectories:
            return self.done.selection
        recipe = self.config.recipe
        saved = time.monotonic()
        for costs in sum_costs(
            velocity,
            shape,
            self.config.intervals,
            metric=weigh_metric(METRICS[recipe.metric], recipe.weights, data.tensors),
            device=data.device,
            condition=data.conditions if self.conditional else None,
            progress=ranks.first,
            done=self.done,
            each=ranks.map,
            **given.model_dump(),
        ):
            self.done = costs
            last = len(costs.optima) == given.trajectories
            due = last or time.monotonic() >= saved + SAVE_SECONDS
            if due and ranks.first:
                save_costs(self.path, costs, self.settings)
                saved = time.monotonic()
        assert self.done is not None
        found = self.done.selection
        if ranks.first:
            tqdm.write(
                f"timesteps {found.grid}: cost {found.cost:.4g}, uniform {found.uniform_cost:.4g}"
            )
        return found


def selection_settings(config: DistillConfig, header: Header) -> dict[str, Any]:
    """All that decides which timesteps are selected, plain values; the arguments are those of
    ``TimestepSelection``."""
    settings: dict[str, Any] = {
        "teacher": header.provenance["teacher"],
        "guidance": config.guidance,
        "intervals": config.intervals,
        "metric": config.recipe.metric,
        "precision": config.precision,
        # How many trajectories run at a time changes rounding only.
        "selection": config.selection.model_dump(exclude={"batch"}),
    }
    if config.recipe.weights:
        settings["weights"] = dict(config.recipe.weights)
    if config.weaker is not None:
        settings["weaker"] = header.provenance["weaker"]
        settings["within"] = config.within
    if header.conditioning:  # each trajectory has the condition of a scan
        settings["data"] = config.data.describe()
        settings["seed"] = config.seed
    return flatten(json.loads(json.dumps(settings)))


def save_costs(path: Path, costs: TrajectoryCosts, settings: dict[str, Any]) -> None:
    """Write costs and their settings, which stand there as JSON.

    Raises:
        FileError: where it cannot be written.
    """
    text = json.dumps(settings, sort_keys=True)
    arrays = asdict(costs)
    seal = {"settings": text, "checksum": _checksum(text, arrays)}
    write_arrays(path, arrays | seal)


def _checksum(settings: str, arrays: Mapping[str, NDArray[Any]]) -> str:
    tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
    return checksum_of({"settings": settings}, tensors)


def load_costs(path: Path, settings: dict[str, Any]) -> TrajectoryCosts:
    """The costs of a selection with these settings.

    Raises:
        ConfigError: where it was made with other ones, which are named.
        DataError: where it is damaged.
        FileError: where it cannot be read.
    """
    values = read_arrays(path)
    with parsing(path, "a selection of timesteps"):
        costs = TrajectoryCosts(values["total"], values["optima"])
        text = str(values["settings"])
        if str(values["checksum"]) != _checksum(text, asdict(costs)):
            raise ValueError("its checksum differs")
    made = parse_json(text, str(path))
    keys = (made | settings).keys() - HARMLESS
    other = sorted(k for k in keys if made.get(k) != settings.get(k))
    if other:
        raise ConfigError(
            f"{path}, which was made with "
            + ", ".join(f"{key}={made.get(key)!r}" for key in other),
            ", ".join(f"{key}={settings.get(key)!r}" for key in other),
            "Remove it to select again, or give another output=FOLDER.",
        )
    return costs
