"""``lidar-synth evaluate``: one set of scans beside another."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer


def evaluate(
    real: Annotated[Path, typer.Argument(metavar="REAL", help="the reference: a dataset's root or a folder")],
    fake: Annotated[Path, typer.Argument(metavar="FAKE", help="the scans to judge, likewise")],
    protocol: Annotated[str, typer.Option(help="r2flow | lidm | town: whose definitions")],
    split: Annotated[str | None, typer.Option(help="split of REAL, r2flow/test for instance")] = None,
    sensor: Annotated[str | None, typer.Option(help="sensor of both: a preset or a YAML file")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="the figures as JSON")] = False,
) -> None:
    """Says how far two sets of scans lie apart from above: Jensen-Shannon distance and MMD.

    The same names mean different things in different papers: figures of two protocols are not comparable, and a
    reference that the model was trained on flatters it.

    \b
    Examples:
      lidar-synth evaluate KITTI-360 samples --protocol r2flow --split r2flow/test
      lidar-synth evaluate town samples --protocol town --json
    """
    from lidar_synth.formats import open_scans
    from lidar_synth.metrics import PROTOCOLS
    from lidar_synth.metrics import evaluate as compare

    if protocol not in PROTOCOLS:
        raise typer.BadParameter(f"{protocol!r} is none of {', '.join(PROTOCOLS)}", param_hint="--protocol")
    sources = open_scans(real, sensor=sensor, split=split), open_scans(fake, sensor=sensor)
    scores = compare(*sources, protocol, progress=not as_json)
    if as_json:
        typer.echo(json.dumps([asdict(score) for score in scores], indent=2))
    else:
        typer.echo("\n".join(map(str, scores)))
