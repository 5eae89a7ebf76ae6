"""The plan of a model: the runs of its stages, checked before the first one begins."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lidar_synth.errors import ConfigError
from lidar_synth.lab.train.config import (
    PARENTS,
    DistillConfig,
    ModelConfig,
    ModelStage,
    Run,
    TrainConfig,
    command_of,
    find_model_file,
    load_config,
    load_model,
    published_models,
    read_values,
)
from lidar_synth.lab.train.config.load import check_latents
from lidar_synth.lab.train.resume import is_missing
from lidar_synth.lab.train.schedules import ENDLESS
from lidar_synth.lab.train.staged import StagedRuns

LEAST = 0.01
"""Least minutes of a stage."""
OUTPUT = "output"


@dataclass(frozen=True)
class PlannedStage:
    """A stage before it begins.

    Args:
        recipe: a published recipe's name or a YAML file.
        config: of its run.
        minutes: its share of the limit of time; None = the iterations of ``config`` end it.
        starts: {key of the configuration: checkpoint that it names}.
        of_others: {key: the stage of another model whose checkpoint it names}.
    """

    recipe: str
    config: TrainConfig | DistillConfig
    minutes: float | None
    starts: Mapping[str, Path]
    of_others: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class ModelPlan:
    """The stages of a model before they begin; as text, the plan with the time of each stage.

    Args:
        name: of the model.
        folder: of its stages.
        stages: those that are needed, by name and in order.
        minutes: limit of the time of all stages without iterations of their own.
        out: the checkpoint that the last one makes.
    """

    name: str
    folder: Path
    stages: Mapping[str, PlannedStage]
    minutes: float
    out: Path

    @property
    def runs(self) -> StagedRuns:
        """The runs of the stages; those with iterations of their own have no share of the time."""
        return StagedRuns(
            self.folder,
            {
                name: s.minutes
                for name, s in self.stages.items()
                if s.minutes is not None
            },
        )

    def __str__(self) -> str:
        """The plan in words."""
        runs = self.runs
        budgets = self.runs.budgets(self.minutes)
        lines = [f"{self.name} -> {self.out}"]
        for name, stage in self.stages.items():
            limit = f"{stage.config.recipe.iterations} iterations"
            if name in budgets:
                limit = f"{budgets[name]:.1f} minutes"
            if runs.is_done(name):
                limit = "done"
            elif spent := runs.spent(name):
                limit += (
                    f", {spent:.1f} of them done"
                    if name in budgets
                    else f", {spent:.1f} minutes done"
                )
            given = [
                f"{key}={path}" + (" (missing)" if is_missing(path) else "")
                for key, path in stage.starts.items()
                if path not in map(runs.checkpoint, self.stages)
            ]
            lines.append(
                f"  {name:<10} {stage.recipe:<24} {limit}"
                + "".join(f"; {one}" for one in given)
            )
        lines.append(
            "The minutes are those of training; casting scans and selecting timesteps take more."
        )
        return "\n".join([*lines, "The same command resumes."])


def plan_model(
    model: str | Path,
    overrides: Sequence[str] = (),
    minutes: float | None = None,
    until: str | None = None,
) -> ModelPlan:
    """The plan of a model.

    Args:
        model: the name of a published model of stages, such as ``town``, or a YAML file like
            those in ``configs/models``.
        overrides: ``STAGE.KEY=VALUE`` for the recipe of one stage, ``KEY=VALUE`` for those of all
            stages, and ``output=FOLDER`` for the folder of the model, ``runs/NAME`` by default. A
            stage with ``recipe.iterations`` runs to them, whatever time it takes. An earlier stage
            whose checkpoint is replaced by another one is left out, unless a further stage needs
            it.
        minutes: limit of the time of all stages, which is shared in proportion to the minutes of
            the model's file; by default their sum.
        until: the last stage to run.

    Returns:
        The plan, for ``train_model``.

    Raises:
        ConfigError: on an unknown model or stage, an override that fits none of its stages, or too
            few minutes.
        FileError: where a file cannot be read.

    Example:
        >>> from lidar_synth.lab.train import plan_model
        >>> plan = plan_model("town", ["teacher.recipe.batch=16"], minutes=155, until="teacher")
        >>> print(plan)
        town -> runs/town/teacher/teacher.safetensors
          codec      town_codec         38.8 minutes
          teacher    town_teacher       116.2 minutes
        The minutes are those of training; ...
    """
    path = find_model_file(model)
    if path is None:
        names = ", ".join(one.name for one in published_models())
        raise ConfigError(
            f"model {str(model)!r}",
            f"a YAML file with the key 'stages', or one of {names}",
        )
    name = path.stem
    settings = load_model(path)
    if until is not None and until not in settings.stages:
        raise ConfigError(
            f"--until {until!r}", f"a stage of {name}: {', '.join(settings.stages)}"
        )
    last = until or list(settings.stages)[-1]
    given = _split(name, overrides, settings)
    folder = Path(given.pop(OUTPUT, [f"runs/{name}"])[-1])
    runs = StagedRuns(folder, {})
    stages = {}
    for stage_name, stage in settings.stages.items():
        stages[stage_name] = _planned(stage_name, stage, path, runs, given[stage_name])
    stages = _needed(stages, last, runs)
    limit = (
        sum(stage.minutes or 0.0 for stage in stages.values())
        if minutes is None
        else minutes
    )
    out = runs.checkpoint(last) if until else folder / f"{name}.safetensors"
    plan = ModelPlan(name, folder, stages, limit, out)
    _check_minutes(plan)
    _check_latents(plan)
    return plan


def _split(
    model: str, overrides: Sequence[str], settings: ModelConfig
) -> dict[str, list[str]]:
    """{name of a stage: overrides of its recipe, those for all stages first}; the model's folder
    under ``OUTPUT``."""
    every, own = [], {name: [] for name in settings.stages}  # type: ignore[var-annotated]
    folder = []
    common = [key for key in Run.model_fields if key != OUTPUT]
    for override in overrides:
        key, _, value = override.partition("=")
        first, dot, rest = key.partition(".")
        if key == OUTPUT:
            folder = [value]
        elif dot and first in own and rest.partition(".")[0] != OUTPUT:
            own[first].append(override.partition(".")[2])
        elif first in common:
            every.append(override)
        else:
            raise ConfigError(
                f"override {override!r}",
                f"STAGE.KEY=VALUE for a stage of {model} ({', '.join(own)}), output=FOLDER, or a "
                f"key of all its recipes ({', '.join(common)})",
                f"Such as {next(iter(own))}.recipe.batch=4.",
            )
    split = {name: [*every, *values] for name, values in own.items()}
    return split | {OUTPUT: folder} if folder else split


def _planned(
    name: str,
    stage: ModelStage,
    path: Path,
    runs: StagedRuns,
    overrides: Sequence[str],
) -> PlannedStage:
    """The run of a stage, with all that it needs."""
    beside = path.parent / stage.recipe
    recipe = beside if beside.is_file() else stage.recipe
    values: dict[str, Any] = {OUTPUT: str(runs.folder_of(name))}
    for key, other in stage.needs.items():
        model, slash, of = other.rpartition("/")
        home = StagedRuns(runs.folder.parent / model, {}) if slash else runs
        values[key] = str(home.checkpoint(of))
    timed = not any(override.startswith("recipe.iterations=") for override in overrides)
    if timed:
        values["recipe"] = {"iterations": ENDLESS, "schedule": "trapezoid"}
    distils = command_of({**read_values(recipe, Run), **values}) == "distill"
    kind: type[TrainConfig] | type[DistillConfig] = (
        DistillConfig if distils else TrainConfig
    )
    config = load_config(kind, recipe, overrides, values)
    if timed and config.recipe.schedule != "trapezoid":
        given = f"{name}.recipe.schedule={config.recipe.schedule} with a limit of time"
        raise ConfigError(given, "trapezoid", f"Or give {name}.recipe.iterations=N.")
    starts = {
        key: Path(start)
        for key in PARENTS
        if (start := getattr(config, key, None)) is not None
    }
    of_others = {
        key: other
        for key, other in stage.needs.items()
        if "/" in other and str(starts.get(key)) == values[key]
    }
    return PlannedStage(
        str(recipe), config, stage.minutes if timed else None, starts, of_others
    )


def _needed(
    stages: Mapping[str, PlannedStage], last: str, runs: StagedRuns
) -> dict[str, PlannedStage]:
    """The stages that the last one starts from, directly or not, and itself."""
    needed = {last}
    for name in reversed(list(stages)):
        if name in needed:
            starts = stages[name].starts.values()
            needed |= {other for other in stages if runs.checkpoint(other) in starts}
    return {name: stage for name, stage in stages.items() if name in needed}


def _check_latents(plan: ModelPlan) -> None:
    made = {plan.runs.checkpoint(name): stage for name, stage in plan.stages.items()}
    for stage in plan.stages.values():
        flow = stage.config
        if isinstance(flow, TrainConfig) and flow.codec in made:
            codec = made[flow.codec].config
            if isinstance(codec, TrainConfig) and codec.init is None:
                check_latents(flow, codec)


def _check_minutes(plan: ModelPlan) -> None:
    shares = plan.runs.shares
    if not shares:
        return
    least = LEAST * sum(shares.values()) / min(shares.values())
    if not least <= plan.minutes < math.inf:
        raise ConfigError(
            f"--minutes {plan.minutes:g} for the stages {', '.join(shares)} of {plan.name}",
            f"at least {least:.2g}",
            f"lidar-synth train {plan.name} --dry-run prints the time of each stage.",
        )
