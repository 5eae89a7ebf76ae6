"""``lidar-synth sample``: generates scans with a model."""

from typing import Annotated

from typer import Option, echo

from lidar_synth.cli.options import Format, Out


def sample(
    out: Out,
    model: Annotated[
        str, Option(help="name of a shipped model, or a .safetensors checkpoint")
    ] = "town",
    count: Annotated[int, Option(min=1, help="number of scans")] = 16,
    seed: Annotated[
        int,
        Option(min=0, help="scan i is a function of the model, the seed and i"),
    ] = 0,
    steps: Annotated[
        int | None, Option(min=1, help="number of steps [the model's own]")
    ] = None,
    times: Annotated[
        str | None,
        Option(help="time grid instead of --steps, such as 1,0.86,0.58,0.22,0"),
    ] = None,
    solver: Annotated[str, Option(help="ODE solver: euler | heun")] = "euler",
    condition: Annotated[
        str | None,
        Option(
            help=(
                "dataset with the labels, images or boxes that a conditional model needs, or a "
                "layout.yaml"
            )
        ),
    ] = None,
    condition_layout: Annotated[
        str | None, Option(help="layout of that dataset [detected]")
    ] = None,
    condition_split: Annotated[
        str | None,
        Option(help="split of that dataset, for instance r2flow/train"),
    ] = None,
    objects: Annotated[
        str | None,
        Option(
            help=(
                "what stands in the boxes of layouts: town, objects that are cast there | "
                "drawn, by the model [town]"
            )
        ),
    ] = None,
    guidance: Annotated[
        float,
        Option(
            min=0, max=100, help="scale of classifier-free guidance; 1 = no guidance"
        ),
    ] = 1.0,
    to: Format = "npz",
    device: Annotated[str, Option(help="device of the network: cpu | cuda")] = "cpu",
    dtype: Annotated[
        str,
        Option(help="data type of the network's computation: float32 | bfloat16"),
    ] = "float32",
    batch: Annotated[
        int | None, Option(min=1, help="scans per batch; limits the memory")
    ] = None,
    columns: Annotated[
        int | None,
        Option(help="columns of the scans, for models that know several"),
    ] = None,
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
    from lidar_synth.bake.conditions import conditions_for, settle_objects
    from lidar_synth.bake.job import DTYPES
    from lidar_synth.bake.samples import ScansOfSeed
    from lidar_synth.errors import choose
    from lidar_synth.formats import WRITERS
    from lidar_synth.generate.flow.solvers import read_grid
    from lidar_synth.generate.loading import load_generator

    writer = choose("--to", to, WRITERS)(out)
    precision = choose("dtype", dtype, DTYPES)
    generator = load_generator(
        model, device=device, dtype=precision, batch=batch, columns=columns
    )
    scans = ScansOfSeed(
        generator,
        seed,
        conditions_for(generator, condition, condition_layout, condition_split),
        settle_objects(generator, objects),
        {
            "steps": steps,
            "times": None if times is None else read_grid(times.split(",")),
            "solver": solver,
            "guidance": guidance,
        },
    )
    asked = {
        "dtype": dtype,
        "to": to,
        "condition": condition,
        "condition_layout": condition_layout,
        "condition_split": condition_split,
        "columns": columns,
    }
    written = scans.write(writer, count, asked)
    echo(f"{out}: {written} scans written, {count - written} were there already")
