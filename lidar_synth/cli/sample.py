"""``lidar-synth sample``: generates scans with a model."""

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lidar_synth.cli.options import Format, Out
from lidar_synth.datasets.recordings import NOTE, seen_by

if TYPE_CHECKING:
    from lidar_synth.bake.conditions import ConditionSource
    from lidar_synth.generate.generator import Generator
    from lidar_synth.geometry.scan import Scan


def sample(
    out: Out,
    model: Annotated[
        str, typer.Option(help="name of a shipped model, or a .safetensors checkpoint")
    ] = "town",
    count: Annotated[int, typer.Option(min=1, help="number of scans")] = 16,
    seed: Annotated[
        int,
        typer.Option(min=0, help="scan i is a function of the model, the seed and i"),
    ] = 0,
    steps: Annotated[
        int | None, typer.Option(min=1, help="number of steps [the model's own]")
    ] = None,
    times: Annotated[
        str | None,
        typer.Option(help="time grid instead of --steps, such as 1,0.86,0.58,0.22,0"),
    ] = None,
    solver: Annotated[str, typer.Option(help="ODE solver: euler | heun")] = "euler",
    condition: Annotated[
        str | None,
        typer.Option(
            help=(
                "dataset with the labels, images or boxes that a conditional model needs, or a "
                "layout.yaml"
            )
        ),
    ] = None,
    condition_layout: Annotated[
        str | None, typer.Option(help="layout of that dataset [detected]")
    ] = None,
    condition_split: Annotated[
        str | None,
        typer.Option(help="split of that dataset, for instance r2flow/train"),
    ] = None,
    objects: Annotated[
        str | None,
        typer.Option(
            help=(
                "what stands in the boxes of layouts: town, objects that are cast there | "
                "drawn, by the model [town]"
            )
        ),
    ] = None,
    guidance: Annotated[
        float,
        typer.Option(
            min=0, max=100, help="scale of classifier-free guidance; 1 = no guidance"
        ),
    ] = 1.0,
    to: Format = "npz",
    device: Annotated[
        str, typer.Option(help="device of the network: cpu | cuda")
    ] = "cpu",
    dtype: Annotated[
        str,
        typer.Option(help="data type of the network's computation: float32 | bfloat16"),
    ] = "float32",
    batch: Annotated[
        int | None, typer.Option(min=1, help="scans per batch; limits the memory")
    ] = None,
    columns: Annotated[
        int | None,
        typer.Option(help="columns of the scans, for models that know several"),
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
    import torch

    from lidar_synth.bake.conditions import conditions_for, fingerprint, settle_objects
    from lidar_synth.errors import choose
    from lidar_synth.formats import WRITERS
    from lidar_synth.generate.flow.solvers import read_grid
    from lidar_synth.generate.loading import load_generator

    writer = choose("--to", to, WRITERS)(out)
    precision = choose(
        "dtype", dtype, {"float32": torch.float32, "bfloat16": torch.bfloat16}
    )
    generator = load_generator(
        model, device=device, dtype=precision, batch=batch, columns=columns
    )
    given = conditions_for(generator, condition, condition_layout, condition_split)
    sampling: dict[str, Any] = {
        "steps": steps,
        "times": None if times is None else read_grid(times.split(",")),
        "solver": solver,
        "guidance": guidance,
    }
    chosen = settle_objects(generator, objects)
    provenance = generator.header.provenance
    settings = sampling | {
        "checkpoint": generator.hash,
        "seed": seed,
        "dtype": dtype,
        "to": to,
        "condition": condition,
        "condition_layout": condition_layout,
        "condition_split": condition_split,
        "conditions": fingerprint(given),
        "columns": columns,
        "objects": chosen,
        "trained_on": provenance["data"],
        "seen": seen_by(provenance).to_list(),
    }
    with writer.hold(NOTE, settings):
        missing = [i for i in range(count) if not writer.complete(i)]
        for index, scan in _generate(generator, seed, missing, given, chosen, sampling):
            writer.write(scan, index)
        writer.finish()
    typer.echo(
        f"{out}: {len(missing)} scans written, {count - len(missing)} were there already"
    )


def _generate(
    generator: "Generator",
    seed: int,
    numbers: Sequence[int],
    given: "ConditionSource | None",
    objects: str | None,
    sampling: dict[str, Any],
) -> "Iterator[tuple[int, Scan]]":
    """The numbers and their scans, with a progress bar."""
    from tqdm import tqdm

    from lidar_synth.bake.conditions import conditions, open_objects

    with tqdm(total=len(numbers), desc="scans", unit="scan") as bar:
        for first in range(0, len(numbers), generator.batch):
            batch = numbers[first : first + generator.batch]
            cast = open_objects(objects, generator.sensor)
            scans = generator.scans(
                seed, batch, conditions(given, batch), cast, **sampling
            )
            yield from zip(batch, scans, strict=True)
            bar.update(len(batch))
