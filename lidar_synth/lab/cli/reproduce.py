"""``lidar-synth reproduce``: a table of the LiDAR-Flow paper, from the data to the figures."""

import os
from pathlib import Path
from typing import Annotated

from typer import Argument, BadParameter, Option, echo


def reproduce(
    table: Annotated[
        str, Argument(metavar="TABLE", help="table1 to table6 of the paper")
    ],
    data: Annotated[
        Path | None,
        Option(
            help="folder with KITTI-360 and SemanticKITTI, or one of them; by default "
            "KITTI360_ROOT and SEMANTICKITTI_ROOT"
        ),
    ] = None,
    out: Annotated[Path, Option(help="folder of runs, scans and features")] = Path(
        "runs/paper"
    ),
    use: Annotated[
        list[str] | None,
        Option(
            metavar="TASK.STAGE=FILE",
            help="a checkpoint or released weights (.pth, .ckpt) instead of a training",
        ),
    ] = None,
    tenth: Annotated[
        bool, Option("--tenth", help="a tenth of the iterations and of the scans")
    ] = False,
    tiny: Annotated[
        bool,
        Option("--tiny", help="small networks on scans of the town, in a minute"),
    ] = False,
    estimate: Annotated[
        bool,
        Option("--estimate", help="print hours by stage, from a minute of each"),
    ] = False,
    weights: Annotated[
        Path | None, Option(help="folder with published weights of extractors")
    ] = None,
    device: Annotated[
        str | None,
        Option(help="device of sampling: cpu | cuda; by default a GPU if there is one"),
    ] = None,
) -> None:
    """Trains what a table needs (autoencoder, teacher, student on timesteps selected for it),
    generates, compares by the paper's protocol and prints the figures below the paper's.

    Run it again to resume; tables share their runs. Table 1 needs KITTI-360, the others
    SemanticKITTI too; 3, 4 and 6 CLIP (LIDAR_SYNTH_CLIP). The tasks are pixel (table 1), latent
    (2), camera (3) and semantic (5); table 4 compares strategies, table 6 times.

    \b
    Examples:
      lidar-synth reproduce table1 --tiny
      lidar-synth reproduce table1 --data DATASETS --estimate
      lidar-synth reproduce table1 --data DATASETS --weights metrics
      lidar-synth reproduce table1 --data DATASETS --use pixel.teacher=r2flow-kitti360-1rf.pth
    """
    from lidar_synth.errors import ConfigError
    from lidar_synth.generate.devices import available_devices
    from lidar_synth.lab.reproduce import report
    from lidar_synth.lab.reproduce.tables import find_table
    from lidar_synth.lab.reproduce.work import TaskRun, find_data, write_town

    if os.environ.get("WORLD_SIZE", "1") != "1":
        raise ConfigError(
            "reproduce in several processes",
            "one",
            "Train its stages with torchrun --nproc-per-node N, then give them: "
            "--use TASK.STAGE=FILE.",
        )
    if tenth and tiny:
        raise BadParameter("give one of the two", param_hint="--tenth, --tiny")
    if weights is not None and not weights.is_dir():
        raise ConfigError(f"--weights {weights}", "a folder that exists")
    spec = find_table(table)
    device = device or [*available_devices()[1:], "cpu"][0]  # the first GPU
    scale = "tiny" if tiny else "tenth" if tenth else "full"
    given = report.given_weights(use or (), spec)
    limit = 1.0 if estimate else None
    works = {
        task: TaskRun(task, out / scale, scale, given[task], device, weights, limit)
        for task in spec.tasks
    }
    find_data(data)
    if tiny:
        write_town(works)
    lines = report.estimate(spec, works)
    if not estimate:
        lines = report.reproduce(table, spec, works)
    for line in lines:
        echo(line)
