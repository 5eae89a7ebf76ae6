"""``lidar-synth doctor``: what this machine has and lacks."""

import json
from typing import Annotated

import typer


def doctor(
    as_json: Annotated[bool, typer.Option("--json", help="the same as JSON")] = False,
) -> None:
    """Says which libraries, devices and data are there, what is missing, and the line that installs it.

    Exit status 0 when the package works, 1 when something that it needs is broken.

    \b
    Examples:
      lidar-synth doctor
      lidar-synth doctor --json
    """
    from lidar_synth.cli.diagnosis import as_dict, examine, report, works

    findings = examine()
    typer.echo(json.dumps(as_dict(findings), indent=2) if as_json else report(findings))
    if not works(findings):
        raise typer.Exit(1)
