"""``lidar-synth town``: procedural streets in the datasets' own layouts."""

from pathlib import Path
from typing import Annotated

import typer


def town(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder to write to.")],
    scans: Annotated[int, typer.Option(help="How many scans.")] = 200,
    seed: Annotated[int, typer.Option(help="Which town.")] = 0,
    layout: Annotated[str, typer.Option(help="kitti360 | semantic_kitti | kitti")] = "kitti360",
    sensor: Annotated[str, typer.Option(help="Whose rays are cast: a preset or a YAML file.")] = "town",
    camera: Annotated[bool, typer.Option(help="Render the camera's picture of each scan (about 1 s each).")] = True,
    interval: Annotated[float, typer.Option(help="Seconds between neighbouring scans.")] = 0.4,
    sequence: Annotated[
        int | None, typer.Option(help="Drive or sequence that takes the scans; 4 for kitti360, 0 for semantic_kitti.")
    ] = None,
    jobs: Annotated[int, typer.Option(help="Worker processes.")] = 1,
) -> None:
    """Write synthetic street scans with labels, boxes, poses and pictures, in a dataset's own folders.

    The scans come from a procedural town, not from a dataset. Run it again to go on where it stopped.

    \b
    Examples:
      lidar-synth town my_town --scans 1000 --seed 1 --layout semantic_kitti --no-camera --jobs 4
      lidar-synth town my_town --scans 100 --layout kitti
      lidar-synth town my_town --scans 500 --sensor os1_128 --no-camera
    """
    from lidar_synth.town import Town, export_town

    source = Town(seed, sensor, scans, interval)
    written, kept = export_town(source, out, layout, sequence=sequence, camera=camera, jobs=jobs)
    print(f"{out}: {written} scans written, {kept} were there already")
