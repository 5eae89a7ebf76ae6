"""``lidar-synth skin``: learn the look of a sensor's returns from real scans, and describe it."""

from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option, Typer

from lidar_synth.cli.options import Json, Reading, drop_missing, options_from

skin = Typer(
    name="skin",
    help="The look of a real sensor's returns, for the town: fit, show.",
    no_args_is_help=True,
)


@skin.command("fit")
@options_from(Reading, after="sensor")
def fit_from_scans(
    scans: Annotated[
        Path,
        Argument(
            metavar="SCANS", help="real scans of one sensor, in any layout that is read"
        ),
    ],
    out: Annotated[
        Path, Option(metavar="FILE", help="file to write; its name ends in .skin")
    ],
    licence: Annotated[str, Option(help="licence of the scans, which the file states")],
    sensor: Annotated[
        str | None, Option(help="sensor of the scans: a preset or a YAML file")
    ] = None,
    most: Annotated[
        int, Option(min=5, help="number of scans to learn from, evenly spaced")
    ] = 100,
    streets: Annotated[
        int, Option(min=1, help="streets of the town that they are compared with")
    ] = 32,
    lasers: Annotated[
        bool, Option(help="give each laser its own offset of reflectance")
    ] = False,
    seed: Annotated[
        int, Option(min=0, help="seed of the town that they are compared with")
    ] = 0,
    **reading: Any,
) -> None:
    """Learns a skin from 20 to 100 real scans, in some minutes; labels are not used.

    \b
    Examples:
      lidar-synth skin fit my_scans --out my.skin --licence "CC BY 4.0"
      lidar-synth skin fit logs --out my.skin --licence none --reflectance-max 255
    """
    from lidar_synth.errors import ConfigError
    from lidar_synth.formats import open_scans
    from lidar_synth.lab.town import fit_skin

    if out.suffix != ".skin":
        raise ConfigError(f"--out {out}", "a name that ends in .skin")
    source = open_scans(scans, sensor=sensor, **drop_missing(reading))
    count = min(most, len(source))
    picked = source.load_readable(i * len(source) // count for i in range(count))
    learnt = fit_skin(
        picked,
        licence=licence,
        source=scans.name,
        seed=seed,
        streets=streets,
        lasers=lasers,
    )
    learnt.save(out)
    print(f"{out}: learnt from {len(picked)} scans of {learnt.sensor.name}")


@skin.command("show")
def show(
    file: Annotated[
        str, Argument(metavar="SKIN", help="a shipped skin by name, or a file")
    ],
    as_json: Json = False,
) -> None:
    """Describes a skin: sensor, scans, licence, and what it changes.

    \b
    Examples:
      lidar-synth skin show pandar64
      lidar-synth skin show my.skin --json
    """
    import json

    from lidar_synth.lab.town import load_skin

    values = load_skin(file).summary()
    if as_json:
        print(json.dumps(values, indent=1))
        return
    for name, value in values.items():
        print(f"{name:<32}{value}")
