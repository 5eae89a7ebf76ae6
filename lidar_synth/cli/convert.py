"""``lidar-synth convert``: scans from any format to any other."""

import sys
from pathlib import Path
from typing import Annotated

import typer


def convert(
    source: Annotated[Path, typer.Argument(metavar="IN", help="A file, a folder of scans or a dataset's root.")],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder to write to.")],
    to: Annotated[
        str,
        typer.Option(
            help="kitti | semantic_kitti | kitti_object | kitti360 | range | pcd | ply | npz | png | webdataset"
        ),
    ],
    sensor: Annotated[str | None, typer.Option(help="Sensor of the input: a preset or a YAML file.")] = None,
    layout: Annotated[str | None, typer.Option(help="Layout of the input, if it is not to be recognised.")] = None,
    split: Annotated[str | None, typer.Option(help="Split of the input, r2flow/train for instance.")] = None,
    as_sensor: Annotated[str | None, typer.Option(help="Re-project to this sensor: a preset or a YAML file.")] = None,
    unfold: Annotated[
        bool, typer.Option("--unfold", help="One row per laser, ring by ring, as KITTI stores them.")
    ] = False,
    fields: Annotated[int | None, typer.Option(help="Floats per point of plain .bin files, if not 4.")] = None,
    reflectance_max: Annotated[
        float | None, typer.Option(help="Upper end of the reflectance in plain files, 255 for instance, if not 1.")
    ] = None,
    on_bad: Annotated[
        str,
        typer.Option(
            help="error | skip | drop-points: stop at what cannot be read, leave the scan out, or leave out its points "
            "that are NaN or infinite."
        ),
    ] = "error",
    jobs: Annotated[int, typer.Option(help="Worker processes.")] = 1,
) -> None:
    """Convert scans from one format to another. Run it again to go on where it stopped.

    Examples:

      lidar-synth convert KITTI-360 out --to semantic_kitti --split r2flow/test --jobs 4

      lidar-synth convert scans out --to pcd --on-bad skip

      lidar-synth convert SemanticKITTI out --to range --as-sensor os1_128

      lidar-synth convert bank out --to webdataset --jobs 4

      lidar-synth convert kitti out --to range --unfold

      lidar-synth convert clouds out --to kitti --reflectance-max 255 --on-bad drop-points
    """
    from lidar_synth.formats import WRITERS, open_scans
    from lidar_synth.formats.convert import convert as run
    from lidar_synth.formats.source import choose
    from lidar_synth.geometry.sensor import load_sensor

    writer = choose("format", to, WRITERS)(out)
    given = {"layout": layout, "split": split, "fields": fields, "reflectance_max": reflectance_max}
    scans = open_scans(source, sensor=sensor, on_bad=on_bad, **given)  # type: ignore[arg-type]
    target = None if as_sensor is None else load_sensor(as_sensor)
    report = run(scans, writer, jobs=jobs, on_bad=on_bad, as_sensor=target, unfold=unfold)  # type: ignore[arg-type]
    print(f"{out}: {report.written} scans written, {report.kept} were there already, {len(report.skipped)} skipped")
    for name, reason in report.skipped.items():
        print(f"  skipped {name}: {reason}", file=sys.stderr)
    for name, count in report.dropped.items():
        print(f"  dropped {count} points of {name}, which are NaN or infinite", file=sys.stderr)
    for what in report.left_out:
        print(f"  left out {what}", file=sys.stderr)
