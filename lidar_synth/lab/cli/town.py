"""``lidar-synth town``: scans of procedural streets in the folder layouts of public datasets."""

from typing import Annotated

from typer import Option

from lidar_synth.cli.options import Out


def town(
    out: Out,
    scans: Annotated[int, Option(help="number of scans")] = 200,
    seed: Annotated[
        int, Option(help="seed of the town: another seed is another town")
    ] = 0,
    layout: Annotated[
        str,
        Option(help="folder layout: kitti360 | semantic_kitti | kitti_object"),
    ] = "kitti360",
    sensor: Annotated[
        str, Option(help="sensor that casts the rays: a preset or a YAML file")
    ] = "town",
    camera: Annotated[
        bool, Option(help="render a camera image of each scan (about 1 s each)")
    ] = True,
    interval: Annotated[float, Option(help="seconds between consecutive scans")] = 0.4,
    sequence: Annotated[
        int | None,
        Option(
            help="number of the drive or sequence to write [4 for kitti360, 0 for semantic_kitti]"
        ),
    ] = None,
    accumulate: Annotated[
        bool,
        Option(
            "--accumulate",
            help="also write KITTI-360's accumulated clouds, for lidar-synth label",
        ),
    ] = False,
    jobs: Annotated[int, Option(help="number of worker processes")] = 1,
    skin: Annotated[
        str | None,
        Option(
            help="look of a real sensor's returns: a shipped skin by name, or a .skin file"
        ),
    ] = None,
) -> None:
    """Writes street scans of a procedural town with labels, boxes, poses and images, in the layout
    of a public dataset.

    No scan comes from a real dataset. Run it again to resume an interrupted run.

    \b
    Examples:
      lidar-synth town my_town --scans 1000 --seed 1 --layout semantic_kitti --no-camera --jobs 4
      lidar-synth town my_town --scans 100 --layout kitti_object
      lidar-synth town my_town --scans 500 --sensor os1_128 --no-camera
      lidar-synth town my_town --scans 100 --accumulate --no-camera
      lidar-synth town my_town --scans 500 --skin my.skin --no-camera
    """
    from lidar_synth.lab.town import Town, export_town

    source = Town(seed, sensor, scans, interval, skin=skin)
    written, kept = export_town(
        source,
        out,
        layout,
        sequence=sequence,
        camera=camera,
        accumulate=accumulate,
        jobs=jobs,
    )
    print(f"{out}: {written} scans written, {kept} were there already")
