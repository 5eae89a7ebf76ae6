"""``lidar-synth sensor``: sensors fitted to scans."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument, Option, Typer, echo

from lidar_synth.cli.options import Json, Reading, drop_missing, options_from

if TYPE_CHECKING:
    from lidar_synth.lab.fitting import SensorFit


@options_from(Reading, after="scans")
def fit_from_scans(
    path: Annotated[
        Path,
        Argument(metavar="PATH", help="file, folder or root of a dataset with scans"),
    ],
    out: Annotated[
        Path, Option(help="YAML file to write, for --sensor of any command")
    ],
    scans: Annotated[
        int, Option(min=1, max=20, help="number of scans to use, evenly spaced")
    ] = 8,
    columns: Annotated[
        int | None, Option(help="columns of the range images [from the firings]")
    ] = None,
    picture: Annotated[
        Path | None, Option(help="PNG file to write with a plot of the fit")
    ] = None,
    as_json: Json = False,
    **reading: Any,
) -> None:
    """Fits a sensor to scans: elevation and azimuth offset of each beam, firings, range limits,
    quantisation.

    The points may be raw or motion compensated, complete or cropped, in the frame of the sensor or
    of the vehicle; then the output says how to bring them into the sensor's, in which the file is.
    If they lie on no beams, the fit fails (exit status 1) and writes nothing.

    \b
    Examples:
      lidar-synth sensor fit my_scans --out my.yaml
      lidar-synth sensor fit my_scans --out my.yaml --scans 20 --picture fit.png
      lidar-synth sensor fit logs --out my.yaml --reflectance-max 255 --on-bad drop-points
      lidar-synth town streets --sensor my.yaml --scans 10 --no-camera
    """
    import json

    from lidar_synth.errors import ConfigError
    from lidar_synth.files.disk import write_file
    from lidar_synth.formats import open_scans
    from lidar_synth.geometry import sensor_yaml, spread
    from lidar_synth.lab.fitting import fit_sensor

    if out.suffix not in (".yaml", ".yml"):
        raise ConfigError(f"--out {out}", "a file that ends in .yaml")
    if picture is not None and picture.suffix != ".png":
        raise ConfigError(f"--picture {picture}", "a file that ends in .png")
    source = open_scans(path, **drop_missing(reading))
    source.skip_sensor_check()
    chosen = source.load_readable(spread(range(len(source)), scans))
    found = fit_sensor(chosen, name=out.stem, columns=columns)
    write_file(out, sensor_yaml(found.sensor).encode())
    if picture is not None:
        from lidar_synth.lab.fitting.picture import fit_figure

        write_file(picture, lambda file: fit_figure(found).savefig(file, format="png"))
    if as_json:
        echo(json.dumps({**_values(found), "sensor": found.sensor.to_dict()}, indent=1))
        return
    for name, value in _values(found).items():
        echo(f"{name:<22}{value}")
    echo(f"{out}: written")


def _values(found: "SensorFit") -> dict[str, object]:
    """What the fit found, and how sure it is, as plain values."""
    import numpy as np

    sensor = found.sensor
    x, y, z = found.mount[:3, 3]
    elevations = sensor.elevations or ()
    tilt = np.degrees(np.arcsin(np.hypot(*found.mount[2, :2])))
    place = f"{x:.3f}, {y:.3f}, {z:.3f} m in the frame of the points, tilted {tilt:.2f} degrees"
    if max(abs(x), abs(y), abs(z)) > 0.3 or tilt > 1:
        place += (
            ". The YAML is of the sensor's own frame (x ahead, y left, z up): before points "
            "(N, 3) are read with it, bring them there by (points - "
            f"[{x:.4f}, {y:.4f}, {z:.4f}]) @ {found.mount[:3, :3].round(6).tolist()}"
        )
    return {
        "beams": f"{len(elevations)}, from {elevations[0]:.2f} to {elevations[-1]:.2f} degrees",
        "looks like": found.vendor or "no sensor of the table of vendors",
        "rings from": found.source,
        "points on a beam": (
            f"{found.share:.1%} within 0.05 degrees; the worst beam {found.within.min():.1%}"
        ),
        "spread of a beam": f"{np.median(found.spread):.4f} degrees (median)",
        "place of the sensor": place,
        "firings per turn": f"{sensor.firings or 'not known'}",
        "azimuth offsets": f"known by {found.azimuths.known}"
        if found.azimuths.known
        else "not known",
        "ranges": f"{found.nearest:.2f} to {found.farthest:.2f} m"
        + (
            f", in steps of {1000 * sensor.range_step:.0f} mm"
            if sensor.range_step
            else ""
        ),
        "reflectance": f"{sensor.reflectance_levels} levels"
        if sensor.reflectance_levels
        else "not in equal steps",
        "uncertain": " ".join(found.uncertain) or "nothing",
    }


sensor = Typer(name="sensor", help="Fits a sensor to scans.", no_args_is_help=True)
sensor.command("fit")(fit_from_scans)
