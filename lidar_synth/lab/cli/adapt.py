"""``lidar-synth adapt``: from a shipped model to the sensor and the streets of the user's scans."""

from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option, echo

from lidar_synth.cli.options import Reading, drop_missing, options_from


@options_from(Reading, after="sensor")
def adapt(
    model: Annotated[
        str,
        Argument(metavar="MODEL", help="a shipped model such as town, or a file"),
    ],
    scans: Annotated[
        Path,
        Option(
            metavar="ROOT", help="20 to 200 scans of one sensor, with labels or without"
        ),
    ],
    out: Annotated[
        Path,
        Option(
            metavar="FILE", help="checkpoint to write; its name ends in .safetensors"
        ),
    ],
    minutes: Annotated[
        float, Option(min=0.01, help="limit of the time of all trainings")
    ] = 120.0,
    licence: Annotated[
        str, Option(help="licence of the scans, which the checkpoint states")
    ] = "that of the scans",
    sensor: Annotated[
        str | None, Option(help="sensor of the scans: a preset or a YAML file")
    ] = None,
    town: Annotated[
        int,
        Option(min=0, help="scans of the town, as your sensor sees it, to learn too"),
    ] = 400,
    dry_run: Annotated[
        bool, Option("--dry-run", help="print the plan and do nothing")
    ] = False,
    **reading: Any,
) -> None:
    """Adapts a model to your sensor and your streets: autoencoder, flow and student.

    The last fifth of the scans is held out for early stopping. A card is written beside the
    checkpoint. Run it again to resume.

    \b
    Examples:
      lidar-synth adapt town --scans my_scans --out mine.safetensors
      lidar-synth adapt town --scans PandaSet/002 --out mine.safetensors --minutes 60 --dry-run
    """
    from lidar_synth.lab.train.adaptation import adapt as run, plan_adaptation

    given = drop_missing(reading)
    if dry_run:
        echo(plan_adaptation(model, scans, out, minutes, sensor, town, **given))
        return
    path = run(
        model,
        scans,
        out,
        minutes=minutes,
        licence=licence,
        sensor=sensor,
        town=town,
        **given,
    )
    echo(f"{path}\nIts card is {path.with_suffix('.md')}")
