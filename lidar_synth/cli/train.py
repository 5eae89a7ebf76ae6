"""``lidar-synth train`` and ``lidar-synth distill``: trains a teacher, distils a student."""

import os
from pathlib import Path
from typing import Annotated

import typer

RecipeName = Annotated[
    str, typer.Argument(metavar="RECIPE", help="name of a recipe (see `lidar-synth recipes`), or a YAML file")
]
Overrides = Annotated[
    list[str] | None, typer.Argument(metavar="[KEY=VALUE]...", help="values of the recipe to override")
]
Resume = Annotated[bool, typer.Option("--resume", help="resume the run in the output folder")]
Minutes = Annotated[float | None, typer.Option(help="save and stop after this many minutes; --resume continues")]


def train(recipe: RecipeName, overrides: Overrides = None, resume: Resume = False, minutes: Minutes = None) -> None:
    """Trains a teacher: a rectified flow from noise to scans.

    The output folder gets the checkpoint, named like the folder; state.safetensors, from which an interrupted run
    resumes with the same losses; logs for TensorBoard; and images of samples. torchrun runs it on several GPUs.

    \b
    Examples:
      lidar-synth train town_codec
      lidar-synth train town_teacher
      lidar-synth train town_teacher --resume recipe.iterations=20000
      lidar-synth train mine.yaml init=runs/town_teacher/town_teacher.safetensors data.path=scans
      torchrun --nproc-per-node 8 -m lidar_synth train kitti360_teacher precision=bf16
    """
    from lidar_synth.train import TrainConfig, load_config, run

    _print_once(run(load_config(TrainConfig, recipe, overrides or ()), resume, minutes))


def distill(recipe: RecipeName, overrides: Overrides = None, resume: Resume = False, minutes: Minutes = None) -> None:
    """Distils a student that needs few steps from a teacher.

    Without a time grid in the configuration, the timesteps are selected first. With a weaker teacher the student learns
    the autoguided velocity (Karras et al. 2024).

    \b
    Examples:
      lidar-synth distill town_student
      lidar-synth distill town_student strategy=uniform_piecewise output=runs/uniform
      lidar-synth distill town_student weaker=null guidance=1 output=runs/plain
      lidar-synth distill kitti360_student teacher=mine.safetensors grid=[1,0.86,0.58,0.22,0]
    """
    from lidar_synth.train import DistillConfig, load_config, run

    _print_once(run(load_config(DistillConfig, recipe, overrides or ()), resume, minutes))


def _print_once(path: Path) -> None:
    """Print the checkpoint's path, in one of the processes of torchrun only."""
    if os.environ.get("RANK", "0") == "0":
        typer.echo(path)
