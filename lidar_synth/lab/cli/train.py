"""``lidar-synth train`` and ``lidar-synth distill``: trains a teacher, distils a student."""

import os
from pathlib import Path
from typing import Annotated

from typer import Argument, Option, echo

RecipeName = Annotated[
    str,
    Argument(
        metavar="RECIPE",
        help="name of a recipe (see `lidar-synth recipes`), or a YAML file",
    ),
]
Overrides = Annotated[
    list[str] | None,
    Argument(metavar="[KEY=VALUE]...", help="values of the recipe to override"),
]
Resume = Annotated[bool, Option("--resume", help="resume the run in the output folder")]
Minutes = Annotated[
    float | None,
    Option(help="save and stop after this many minutes; --resume continues"),
]


def train(
    recipe: Annotated[
        str,
        Argument(
            metavar="RECIPE|MODEL",
            help=(
                "name of a recipe or of a model of several stages (see `lidar-synth recipes`), "
                "or a YAML file"
            ),
        ),
    ],
    overrides: Overrides = None,
    resume: Resume = False,
    minutes: Annotated[
        float | None,
        Option(
            help=(
                "save and stop after this many minutes; --resume continues. Of a model: limit of "
                "all stages"
            )
        ),
    ] = None,
    until: Annotated[
        str | None,
        Option(metavar="STAGE", help="of a model: the last stage to run"),
    ] = None,
    dry_run: Annotated[
        bool, Option("--dry-run", help="of a model: print the time of each stage")
    ] = False,
) -> None:
    """Trains a teacher, a rectified flow from noise to scans; or a model by all its stages.

    The output folder gets the checkpoint, named like the folder; state.safetensors, from which an
    interrupted run resumes with the same losses; logs for TensorBoard; and images of samples.
    torchrun runs it on several GPUs.

    A model such as town has several stages: autoencoder, teacher, student, decoder. Each gets
    its share of the minutes. The same command resumes. STAGE.KEY=VALUE changes the recipe of a
    stage, KEY=VALUE all of them.

    \b
    Examples:
      lidar-synth train town --dry-run
      lidar-synth train town --minutes 600 teacher.recipe.batch=16
      lidar-synth train town --until teacher output=runs/town
      lidar-synth train town-layout teacher.init=tools/stages/town_teacher.safetensors
      lidar-synth train town_codec
      lidar-synth train town_teacher
      lidar-synth train town_teacher --resume recipe.iterations=20000
      lidar-synth train mine.yaml init=runs/town_teacher/town_teacher.safetensors data.path=scans
      torchrun --nproc-per-node 8 -m lidar_synth train kitti360_teacher precision=bf16
    """
    from lidar_synth.errors import ConfigError
    from lidar_synth.lab.train import (
        TrainConfig,
        load_config,
        plan_model,
        run,
        train_model,
    )
    from lidar_synth.lab.train.config import find_model_file

    if find_model_file(recipe) is not None:
        plan = plan_model(recipe, overrides or (), minutes, until)
        if dry_run:
            echo(plan)
        else:
            _print_once(train_model(plan))
        return
    if until is not None or dry_run:
        given = "--dry-run" if dry_run else f"--until {until}"
        raise ConfigError(
            f"{given} for the recipe {recipe}",
            "a model of several stages, such as town",
        )
    _print_once(run(load_config(TrainConfig, recipe, overrides or ()), resume, minutes))


def distill(
    recipe: RecipeName,
    overrides: Overrides = None,
    resume: Resume = False,
    minutes: Minutes = None,
) -> None:
    """Distils a student that needs few steps from a teacher.

    Without a time grid in the configuration, the timesteps are selected first. With a weaker
    teacher the student learns the autoguided velocity (Karras et al. 2024).

    \b
    Examples:
      lidar-synth distill town_student
      lidar-synth distill town_student strategy=uniform_piecewise also=[] output=runs/uniform
      lidar-synth distill town_student weaker=null guidance=1 output=runs/plain
      lidar-synth distill kitti360_student teacher=mine.safetensors grid=[1,0.86,0.58,0.22,0]
    """
    from lidar_synth.lab.train import DistillConfig, load_config, run

    _print_once(
        run(load_config(DistillConfig, recipe, overrides or ()), resume, minutes)
    )


def _print_once(path: Path) -> None:
    """Print the checkpoint's path, in one of the processes of torchrun only."""
    if os.environ.get("RANK", "0") == "0":
        echo(path)
