"""``lidar-synth doctor``: checks this machine's libraries, devices and data."""

import json

from typer import Exit, echo

from lidar_synth.cli.options import Json


def doctor(as_json: Json = False) -> None:
    """Lists available and missing libraries, devices and data, and the command that installs what
    is missing.

    Exit status 0 = the package works, 1 = a required part is missing or broken.

    \b
    Examples:
      lidar-synth doctor
      lidar-synth doctor --json
    """
    from lidar_synth.cli.diagnosis import as_dict, examine, report, works

    findings = examine()
    echo(json.dumps(as_dict(findings), indent=2) if as_json else report(findings))
    if not works(findings):
        raise Exit(1)
