"""Training, sampling and comparison of one task; what is done already is not repeated.

The folder holds::

    RECIPE/, RECIPE_STRATEGY/    runs
    estimate/                    runs of an estimate
    cache/                       projected scans, which the runs of a task share
    imported/                    released weights that were given in place of a run
    samples/RECIPE-STEPS/        generated scans
    features/                    features of published weights
"""

import math
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from lidar_synth.bake.conditions import conditions, conditions_for
from lidar_synth.cli.sample import sample
from lidar_synth.errors import ConfigError
from lidar_synth.files.disk import sha256
from lidar_synth.files.recipes import folder as recipes_folder, merge
from lidar_synth.formats import open_scans
from lidar_synth.generate.checkpoint import save_checkpoint
from lidar_synth.generate.loading import load_generator
from lidar_synth.generate.models.encoders.clip_views import find_clip
from lidar_synth.geometry import Source, load_sensor
from lidar_synth.lab.evaluate import Score, evaluate
from lidar_synth.lab.importers import IMPORTERS
from lidar_synth.lab.reproduce.tables import Task, read_tables
from lidar_synth.lab.town import Town, export_town
from lidar_synth.lab.train.config import DistillConfig, TrainConfig, load_config
from lidar_synth.lab.train.config.load import Config
from lidar_synth.lab.train.resume import check_done
from lidar_synth.lab.train.runs import run
from lidar_synth.lab.train.state import Recipe, read_progress

SCALES = {"full": 1, "tenth": 10, "tiny": 1000}
"""By what iterations and generated scans are divided."""
VARIABLES = {"kitti360": "KITTI360_ROOT", "semantic_kitti": "SEMANTICKITTI_ROOT"}
"""The variables by which recipes name the datasets."""
MARKS = {"kitti360": "data_3d_raw", "semantic_kitti": "sequences"}
PEERS = {".pth": "r2flow", ".ckpt": "lidm"}
"""Projects by the suffix of their released weights."""
SENSOR = recipes_folder() / "tiny_sensor.yaml"
TINY = {"kitti360": (4, 3), "semantic_kitti": (0, 8)}
"""Drives of the town that is written for ``tiny``: trained on, compared with."""

_hash = lru_cache(sha256)


@dataclass(frozen=True)
class TaskRun:
    """A task at a scale.

    Args:
        name: of the task.
        folder: for everything that is made.
        scale: a name of ``SCALES``.
        given: {stage: checkpoint or released weights that take the place of its run}.
        device: on which scans are generated.
        weights: folder of the published weights of extractors.
        minutes: limit of each run, for an estimate.
    """

    name: str
    folder: Path
    scale: str = "full"
    given: Mapping[str, Path] = field(default_factory=dict)
    device: str = "cpu"
    weights: Path | None = None
    minutes: float | None = None

    @property
    def task(self) -> Task:
        """What is done."""
        return read_tables().tasks[self.name]

    @property
    def runs(self) -> Path:
        """The folder of the runs."""
        return self.folder / ("" if self.minutes is None else "estimate")

    @property
    def count(self) -> int:
        """Number of generated scans."""
        return math.ceil(self.task.scans / SCALES[self.scale])

    def run_name(self, stage: str) -> str:
        """The recipe of a stage; of a strategy, its student's with the strategy's name."""
        stages = self.task.stages
        return stages[stage] if stage in stages else f"{stages['student']}_{stage}"

    def checkpoint(self, stage: str) -> Path:
        """The checkpoint of a stage."""
        if stage not in self.given:
            name = self.run_name(stage)
            return self.runs / name / f"{name}.safetensors"
        path = self.given[stage]
        if path.suffix not in PEERS:
            return path
        # two files may have one name
        name = f"{path.stem}-{_hash(path)[:12]}.safetensors"
        out = self.folder / "imported" / name
        if not out.exists():
            out.parent.mkdir(parents=True, exist_ok=True)
            save_checkpoint(out, *IMPORTERS[PEERS[path.suffix]](path))
        return out

    def stages(self, last: str) -> list[str]:
        """The stages whose runs a stage needs, in order, and itself."""
        if last in self.given:
            return []
        if last == "codec" or (last == "teacher" and "codec" not in self.task.stages):
            return [last]
        return [*self.stages("codec" if last == "teacher" else "teacher"), last]

    def config(self, stage: str) -> TrainConfig | DistillConfig:
        """The run of a stage.

        Raises:
            ConfigError, FileError: as ``load_config``.
        """
        values: dict[str, Any] = {"output": str(self.runs / self.run_name(stage))}
        first = stage if stage == "codec" else "teacher"
        cache = self.folder / "cache" / self.run_name(first)
        values["data"] = {"cache": str(cache)}
        if self.scale == "tiny":
            values = self._tiny(values, stage)
        recipe = self.task.stages.get(stage, self.task.stages["student"])
        if stage in ("codec", "teacher"):
            if stage == "teacher" and "codec" in self.task.stages:
                values["codec"] = str(self.checkpoint("codec"))
            return self._shortened(load_config(TrainConfig, recipe, values=values))
        values |= {"teacher": str(self.checkpoint("teacher")), "grid": None}
        if stage != "student":
            values["strategy"] = stage
        if self.minutes is not None:
            values["selection"] = {"trajectories": 1}
        return self._shortened(load_config(DistillConfig, recipe, values=values))

    def _tiny(self, values: dict[str, Any], stage: str) -> dict[str, Any]:
        """The values of a small run on top of others."""
        keys = ["all", stage if stage in ("codec", "teacher") else "student"]
        if stage == "teacher":
            keys += ["unet" if "codec" in self.task.stages else "hdit", self.name]
        for key in keys:
            values = merge(values, read_tables().tiny.get(key, {}))
        if "sensor" in values:
            values["sensor"] = str(SENSOR)
        return values

    def _shortened(self, config: Config) -> Config:
        """The same run with a tenth of its steps, at that scale."""
        if self.scale != "tenth":
            return config
        recipe = config.recipe
        shares = {
            key: getattr(recipe, key) // SCALES[self.scale]
            for key in ("iterations", "warmup", "ema_after")
        }
        changed: Recipe = replace(recipe, **shares)
        return config.model_copy(update={"recipe": changed})

    @property
    def evaluations(self) -> int:
        """Evaluations of the teacher in the selection of timesteps."""
        config = self.config("student")
        assert isinstance(config, DistillConfig)
        return config.selection.trajectories * config.selection.candidates

    def check(self, stages: Sequence[str]) -> None:
        """Refuse, before the first training, a dataset or weights of CLIP that are not there.

        Raises:
            ConfigError, FileError, LibraryError: naming them.
        """
        for stage in stages:
            config = self.config(stage)
            config.data.open(load_sensor(str(SENSOR)))  # which only the town needs
            condition = getattr(config, "condition", None)
            if condition is not None and condition.encoder == "clip_views":
                find_clip(self.device)

    def train(self, stage: str) -> None:
        """Run a stage, or what is left of it.

        Raises:
            ConfigError: if it was done with other settings, or from other checkpoints.
        """
        config = self.config(stage)
        done = read_progress(config.output).step >= config.recipe.iterations
        if not (done and config.checkpoint.exists()):
            run(config, resume=True, minutes=self.minutes)
        else:
            check_done(config)

    def condition_scans(self) -> Sequence[str | None]:
        """Path, layout and split of the scans that are conditions; None where there are none."""
        task = self.task
        if not task.conditional:
            return [None] * 3
        return str(self.reference), task.layout, task.split

    def sample(self, stage: str, steps: int) -> Path:
        """Generate the scans of a row."""
        out = self.folder / "samples" / f"{self.run_name(stage)}-{steps}"
        path, layout, split = self.condition_scans()
        sample(
            out,
            model=str(self.checkpoint(stage)),
            count=self.count,
            steps=steps,
            device=self.device,
            condition=path,
            condition_layout=layout,
            condition_split=split,
        )
        return out

    def compare(self, stage: str, steps: int, left_out: dict[str, str]) -> list[Score]:
        """Generate the scans of a row and compare them by the task's protocol; ``left_out`` is
        filled as by ``evaluate``."""
        task = self.task
        generated = open_scans(self.sample(stage, steps))
        return evaluate(
            self.open_reference(),
            generated,
            task.protocol,
            weights=self.weights,
            anyway=self.scale != "full",
            training_data=task.split == "all",  # as R2Flow compares
            cache=self.folder / "features",
            left_out=left_out,
        )

    def seconds(self, stage: str, steps: int) -> float:
        """Seconds of one scan by itself, the mean of two after a first one."""
        generator = load_generator(self.checkpoint(stage), device=self.device)
        given = conditions_for(generator, *self.condition_scans())
        moments = []
        for i in range(3):
            generator.scans(0, [i], conditions(given, [i]), steps=steps)
            moments.append(time.perf_counter())
        return (moments[2] - moments[0]) / 2

    def open_reference(self) -> Source:
        """The scans that are compared with; raises as ``open_scans``, and as ``reference``."""
        task = self.task
        return open_scans(self.reference, layout=task.layout, split=task.split)

    @property
    def reference(self) -> Path:
        """The dataset that is compared with.

        Raises:
            ConfigError: if it is not given.
        """
        layout = self.task.layout
        if VARIABLES[layout] not in os.environ:
            raise ConfigError(
                f"no {VARIABLES[layout]} for {self.name}",
                f"--data ROOT with the dataset's folder {MARKS[layout]}",
            )
        root = Path(os.environ[VARIABLES[layout]])
        if self.scale == "tiny":
            return root.with_name(f"{layout}-{TINY[layout][1]}")
        return root


def find_data(root: Path | None) -> None:
    """Let recipes find the datasets in ``root``, or in folders of it; one that is not there stays
    where the environment names it.

    Raises:
        ConfigError: where there is neither KITTI-360 nor SemanticKITTI.
    """
    if root is None:
        return
    found = {}
    for layout, mark in MARKS.items():
        for path in (*root.glob(f"*/*/{mark}"), *root.glob(f"*/{mark}"), root / mark):
            if path.is_dir():
                found[VARIABLES[layout]] = str(path.parent)
    if not found:
        raise ConfigError(
            f"{root} without {' or '.join(MARKS.values())}",
            "a folder with KITTI-360 or SemanticKITTI",
        )
    os.environ.update(found)


def write_town(works: Mapping[str, TaskRun]) -> None:
    """Write the scans of the town that take the place of the datasets at the scale "tiny"."""
    for work in works.values():
        layout = work.task.layout
        for seed, number in enumerate(TINY[layout]):
            out = work.folder / "town" / f"{layout}-{number}"
            # with images for every table, so that all tables share one cache
            camera = layout == "kitti360"
            export_town(
                Town(seed, SENSOR, 2), out, layout, sequence=number, camera=camera
            )
            if seed == 0:
                os.environ[VARIABLES[layout]] = str(out)
