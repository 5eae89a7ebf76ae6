"""``lidar-synth convert``: converts scans from any supported format to any other."""

import sys
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Option

from lidar_synth.cli.options import (
    Format,
    Out,
    Reading,
    Source,
    drop_missing,
    options_from,
)

if TYPE_CHECKING:
    from lidar_synth.formats import ScanFiles
    from lidar_synth.formats.convert import Report


InputSensor = Annotated[
    str | None,
    Option(help="sensor of the input: a preset or a YAML file [named by the files]"),
]
AsSensorName = Annotated[
    str | None,
    Option(
        help="scans as this sensor would have recorded them: a preset or a YAML file"
    ),
]
MountText = Annotated[
    str | None,
    Option(
        metavar="Z,PITCH",
        help="of --as-sensor: metres higher, degrees looking further down [0,0]",
    ),
]
Sweeps = Annotated[
    int,
    Option(
        help="of --as-sensor: scans before and after, which fill gaps by their poses"
    ),
]
Like = Annotated[
    Path | None,
    Option(help="of --as-sensor: real scans of that sensor, to match its reflectance"),
]
RangeNoise = Annotated[
    float, Option(help="of --as-sensor: metres, noise beyond that of the input")
]
Reach = Annotated[
    float | None,
    Option(
        help=(
            "of --as-sensor: metres at which it loses every second ray to a surface of 10 % "
            "reflectance"
        )
    ),
]
Unfold = Annotated[
    bool,
    Option(
        "--unfold", help="assign one row to each laser, from KITTI's order of points"
    ),
]
Strict = Annotated[
    bool,
    Option(
        "--strict", help="stop at a scan with something that the format cannot hold"
    ),
]
Jobs = Annotated[int, Option(help="number of worker processes")]


@options_from(Reading, after="sensor")
def convert(
    source: Source,
    out: Out,
    to: Format,
    sensor: InputSensor = None,
    as_sensor: AsSensorName = None,
    mount: MountText = None,
    sweeps: Sweeps = 0,
    like: Like = None,
    range_noise: RangeNoise = 0.0,
    reach: Reach = None,
    unfold: Unfold = False,
    strict: Strict = False,
    jobs: Jobs = 1,
    **reading: Any,
) -> None:
    """Converts scans from one format to another. Run it again to resume an interrupted conversion.

    \b
    Examples:
      lidar-synth convert KITTI-360 out --to semantic_kitti --split r2flow/test --jobs 4
      lidar-synth convert scans out --to pcd --on-bad skip
      lidar-synth convert SemanticKITTI out --to kitti --as-sensor hdl32e_nuscenes --mount 0.1,0
      lidar-synth convert bank out --to webdataset --jobs 4
      lidar-synth convert kitti out --to range --unfold
      lidar-synth convert clouds out --to kitti --reflectance-max 255 --on-bad drop-points
    """
    from lidar_synth.errors import choose
    from lidar_synth.formats import WRITERS, open_scans
    from lidar_synth.formats.convert import convert as run

    writer = choose("--to", to, WRITERS)(out)
    scans = open_scans(source, sensor=sensor, **drop_missing(reading))
    change = _change(
        scans, as_sensor, mount, sweeps, like, range_noise=range_noise, reach=reach
    )
    report = run(
        scans,
        writer,
        jobs=jobs,
        on_bad=scans.on_bad,
        as_sensor=change,
        unfold=unfold,
        strict=strict,
    )
    print_report(report, out, to, as_sensor)


def print_report(
    report: "Report", out: Path, to: str, as_sensor: str | None = None
) -> None:
    """What was written, and on standard error what was not."""
    print(
        f"{out}: {report.written} scans written, {report.kept} were there already, "
        f"{len(report.skipped)} skipped"
    )
    if report.seen:
        print(
            f"  {100 * sum(report.seen) / len(report.seen):.0f} % of the field of view of "
            f"{as_sensor} was seen"
        )
    notes = [f"skipped {name}: {reason}" for name, reason in report.skipped.items()]
    notes += [
        f"dropped {count} points of {name}, which are NaN or infinite"
        for name, count in report.dropped.items()
    ]
    notes += [
        f"dropped {name} of {count} scans, which {to} cannot hold"
        for name, count in report.lost.items()
    ]
    if report.unlabelled:
        notes.append(
            f"labels of {report.unlabelled} scans are unknown: written as 0, unlabelled"
        )
    notes += [f"left out {what}" for what in report.left_out]
    for note in notes:
        print(f"  {note}", file=sys.stderr)


def _change(
    scans: "ScanFiles",
    as_sensor: str | None,
    mount: str | None,
    sweeps: int,
    like: Path | None,
    **how: Any,
) -> Any:
    """What ``--as-sensor`` and its options do to the scans; None without it."""
    from lidar_synth.errors import ConfigError
    from lidar_synth.formats.as_sensor import AsSensor, make_transfer

    if as_sensor is None:
        given = {"mount": mount, "sweeps": sweeps, "like": like, **how}
        if any(given.values()):
            raise ConfigError(
                f"{', '.join(filter(given.get, given))} without --as-sensor",
                "the sensor that the scans are turned into",
            )
        return None
    return AsSensor(
        make_transfer(as_sensor, read_mount(mount), like, scans, **how), sweeps
    )


def read_mount(text: str | None) -> tuple[float, float]:
    """Metres and degrees of the text Z,PITCH."""
    expected = "metres and degrees, for instance 0.1,0"
    z, pitch = read_numbers(f"--mount {text}", text or "0,0", (2,), expected)
    return z, pitch


def read_numbers(
    given: str, text: str, counts: tuple[int, ...], expected: str
) -> list[float]:
    """The numbers of a text, with commas between them.

    Raises:
        ConfigError: on another text, or another count of numbers.
    """
    from lidar_synth.errors import ConfigError

    with suppress(ValueError):
        values = list(map(float, text.split(",")))
        if len(values) in counts:
            return values
    raise ConfigError(given, expected)
