"""``lidar-synth convert``: converts scans from any supported format to any other."""

import sys
from pathlib import Path
from typing import Annotated

import typer


def convert(
    source: Annotated[Path, typer.Argument(metavar="IN", help="file, folder of scans or root of a dataset")],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="folder to write to")],
    to: Annotated[
        str,
        typer.Option(
            help="format: kitti | semantic_kitti | kitti_object | kitti360 | range | pcd | ply | npz | png | webdataset"
        ),
    ],
    sensor: Annotated[
        str | None, typer.Option(help="sensor of the input: a preset or a YAML file [named by the files]")
    ] = None,
    layout: Annotated[str | None, typer.Option(help="layout of the input [detected]")] = None,
    split: Annotated[str | None, typer.Option(help="split of the input, for instance r2flow/train")] = None,
    as_sensor: Annotated[str | None, typer.Option(help="re-project to this sensor: a preset or a YAML file")] = None,
    unfold: Annotated[
        bool, typer.Option("--unfold", help="assign one row to each laser, from KITTI's order of points")
    ] = False,
    fields: Annotated[int | None, typer.Option(help="floats per point in plain .bin files [4]")] = None,
    reflectance_max: Annotated[
        float | None, typer.Option(help="highest reflectance value in plain files, for instance 255 [1]")
    ] = None,
    on_bad: Annotated[
        str,
        typer.Option(
            help="bad scans: error = stop at the first one | skip = leave them out | drop-points = leave out their NaN "
            "and infinite points"
        ),
    ] = "error",
    jobs: Annotated[int, typer.Option(help="number of worker processes")] = 1,
) -> None:
    """Converts scans from one format to another. Run it again to resume an interrupted conversion.

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
