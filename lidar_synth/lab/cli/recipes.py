"""``lidar-synth recipes``: lists the published training configurations."""

import json
from dataclasses import asdict
from typing import Annotated

import typer


def recipes(
    name: Annotated[
        str | None,
        typer.Argument(metavar="[NAME]", help="print the file of this recipe"),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="print JSON")] = False,
) -> None:
    """Lists the recipes and the models of several stages of the package with data, size and
    expected time of each.

    \b
    Examples:
      lidar-synth recipes
      lidar-synth recipes town_teacher > mine.yaml
      lidar-synth recipes town
      lidar-synth train town_teacher data.path=scans data.town=null output=runs/mine
    """
    from lidar_synth.lab.train.config import (
        find_model_file,
        find_recipe,
        published,
        published_models,
    )

    if name is not None:
        typer.echo(
            (find_model_file(name) or find_recipe(name)).read_text(encoding="utf-8"),
            nl=False,
        )
        return
    listed = [*published_models(), *published()]
    if as_json:
        typer.echo(json.dumps([asdict(one) for one in listed], indent=1))
        return
    rows = [("recipe", "command", "data", "parameters", "time")]
    rows += [(one.name, one.command, one.data, one.size, one.time) for one in listed]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        typer.echo(
            "  ".join(
                cell.ljust(width) for cell, width in zip(row, widths, strict=True)
            ).rstrip()
        )
