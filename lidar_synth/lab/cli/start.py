"""``lidar-synth start``: from a folder of scans to a mixture for a training."""

from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option, echo

from lidar_synth.cli.options import Reading, drop_missing, options_from


@options_from(Reading, after="sensor")
def start(
    root: Annotated[
        Path,
        Argument(metavar="ROOT", help="scans in any layout, with labels or without"),
    ],
    out: Annotated[
        Path, Option(help="folder of all that is made, and needed to resume")
    ] = Path("start"),
    sensor: Annotated[
        str | None,
        Option(help="sensor of the scans: a preset or a YAML file [known or fitted]"),
    ] = None,
    task: Annotated[
        str | None,
        Option(help="segmentation | detection [what the scans have labels for]"),
    ] = None,
    scans: Annotated[int, Option(min=1, help="synthetic scans to make")] = 200,
    minutes: Annotated[
        float,
        Option(min=0, help="limit of the comparison with real scans; 0 = none"),
    ] = 10.0,
    trainer: Annotated[
        str | None,
        Option(
            help="write its configuration too: mmdet3d | openpcdet | pointcept | "
            "rangenet | cylinder3d | open3d_ml | waffleiron | lightning"
        ),
    ] = None,
    jobs: Annotated[
        int | None, Option(min=1, help="processes [one for each core]")
    ] = None,
    dry_run: Annotated[
        bool,
        Option(
            "--dry-run",
            help="print what was found, and the time and disk space needed",
        ),
    ] = False,
    **reading: Any,
) -> None:
    """Begins with your scans: finds layout, labels, boxes and sensor, makes synthetic scans,
    compares trainings with and without them, and prints code and configuration for your trainer.

    Run it again to resume.

    \b
    Examples:
      lidar-synth start SemanticKITTI --trainer mmdet3d
      lidar-synth start logs --out begin --dry-run
      lidar-synth start PandaSet --sensor pandar64 --minutes 0
    """
    from lidar_synth.lab.start import start as run

    made = run(
        root,
        out,
        sensor=sensor,
        task=task,
        scans=scans,
        minutes=minutes,
        trainer=trainer,
        jobs=jobs,
        dry_run=dry_run,
        say=echo,
        **drop_missing(reading),
    )
    if made is not None:
        echo(f"\n{made}")
