"""``lidar-synth sample``: generates scans with a model."""

from typing import Annotated, Any

from typer import Option

from lidar_synth.bake.options import Drawing
from lidar_synth.cli.convert import print_report
from lidar_synth.cli.options import Format, Out, drop_missing, options_from


@options_from(Drawing, after="out")
def sample(
    out: Out,
    times: Annotated[
        str | None,
        Option(help="time grid instead of --steps, such as 1,0.86,0.58,0.22,0"),
    ] = None,
    to: Format = "npz",
    **settings: Any,
) -> None:
    """Generates scans and writes them in any format. Run it again to resume an interrupted run.

    A conditional model generates scan i from scan i of the dataset of conditions, modulo the length
    of that dataset.

    \b
    Examples:
      lidar-synth sample out
      lidar-synth sample out --count 100 --seed 7 --to semantic_kitti
      lidar-synth sample out --model runs/town_teacher/town_teacher.safetensors --steps 50
      lidar-synth sample out --model semantic.safetensors --condition SemanticKITTI \\
          --condition-split val
      lidar-synth sample out --model town-layout --condition behind_a_van.yaml
    """
    from lidar_synth.bake.samples import write_samples
    from lidar_synth.files.recipes import validate
    from lidar_synth.generate.flow.solvers import read_grid

    job = validate(Drawing, drop_missing(settings), "sample")
    grid = None if times is None else read_grid(times.split(","))
    print_report(write_samples(out, job, to, grid), out, to)
