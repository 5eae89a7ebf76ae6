"""``lidar-synth recipes``: lists the published training configurations, and writes those of
trainers."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option, echo

from lidar_synth.cli.options import Json
from lidar_synth.errors import choose


def recipes(
    name: Annotated[
        str | None,
        Argument(metavar="[NAME]", help="print the file of this recipe"),
    ] = None,
    as_json: Json = False,
    trainer: Annotated[
        str | None,
        Option(
            help="print the files that a trainer needs for a mixture: mmdet3d | "
            "openpcdet | pointcept | rangenet | cylinder3d | open3d_ml | waffleiron | lightning"
        ),
    ] = None,
    task: Annotated[
        str | None,
        Option(help="of the trainer: segmentation | detection [what it can]"),
    ] = None,
    root: Annotated[
        str, Option(help="folder of the real scans, in the trainer's files")
    ] = "/data/scans",
    synthetic: Annotated[
        str, Option(help="bank, model or folder, in the trainer's files")
    ] = "/data/bank",
    out: Annotated[
        Path | None, Option(help="folder to write the trainer's files to")
    ] = None,
    schema: Annotated[
        str | None,
        Option(help="print the JSON schema of: bake | distill | model | train"),
    ] = None,
) -> None:
    """Lists recipes and multi-stage models with their data, size and expected time.

    \b
    Examples:
      lidar-synth recipes
      lidar-synth recipes town_teacher > mine.yaml
      lidar-synth recipes town
      lidar-synth recipes --trainer openpcdet --root KITTI --synthetic town_scans --out mixed
      lidar-synth recipes --schema train > train.schema.json
      lidar-synth train town_teacher data.path=scans data.town=null output=runs/mine
    """
    from lidar_synth.lab.train.config import find_model_file, find_recipe

    if trainer is not None:
        _configure(trainer, task, root, synthetic, out)
    elif schema is not None:
        echo(json.dumps(_schema(schema), indent=1))
    elif name is not None:
        path = find_model_file(name) or find_recipe(name)
        echo(path.read_text(encoding="utf-8"), nl=False)
    else:
        _list(as_json)


def _list(as_json: bool) -> None:
    from lidar_synth.lab.train.config import published, published_models

    listed = [*published_models(), *published()]
    if as_json:
        echo(json.dumps([asdict(one) for one in listed], indent=1))
        return
    rows = [("recipe", "command", "data", "parameters", "time")]
    rows += [(one.name, one.command, one.data, one.size, one.time) for one in listed]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        echo("  ".join(map(str.ljust, row, widths)).rstrip())


def _schema(name: str) -> dict[str, Any]:
    """The JSON schema of a kind of recipe, by which editors complete and check its keys."""
    from pydantic import BaseModel

    from lidar_synth.bake import BakeJob
    from lidar_synth.lab.train.config import DistillConfig, ModelConfig, TrainConfig

    kinds: dict[str, type[BaseModel]] = {
        "bake": BakeJob,
        "distill": DistillConfig,
        "model": ModelConfig,
        "train": TrainConfig,
    }
    return choose("--schema", name, kinds).model_json_schema()


def _configure(
    trainer: str,
    task: str | None,
    root: str,
    synthetic: str,
    out: Path | None,
) -> None:
    """Print or write the files of a trainer."""
    from lidar_synth.files.hub import refuse_ambiguous
    from lidar_synth.lab.start.trainers import (
        DEFAULTS,
        configure,
        tasks_of,
        write_files,
    )

    task = task or tasks_of(trainer)[0]
    refuse_ambiguous(synthetic)
    # The trainer runs in its own folder; names and URLs stay.
    root, synthetic = (
        str(Path(given).resolve()) if Path(given).exists() else given
        for given in (root, synthetic)
    )
    settings = {
        "synthetic": synthetic,
        **choose("--task", task, DEFAULTS),
        "seed": 0,
    }
    here = str((out or Path()).resolve())
    files = configure(trainer, task, settings, root, here)
    if out is None:
        echo("\n".join(f"# {name}\n{text}" for name, text in files.items()))
        return
    write_files(files, out)
    echo("\n".join(f"{out / name}: written" for name in files))
