"""``lidar-synth bake``: a bank of scans from a model."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lidar_synth.bake.options import BakeJob
from lidar_synth.cli.options import options_from

if TYPE_CHECKING:
    from lidar_synth.bake import BakePlan, Resources


@options_from(BakeJob, after="config")
def bake(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="folder of the bank")],
    config: Annotated[Path | None, typer.Option(help="YAML with these options; what is given here goes first")] = None,
    engine: Annotated[str, typer.Option(help="local | processes | ray | slurm | torchrun")] = "local",
    workers: Annotated[int | None, typer.Option(help="processes, actors or jobs [one per core, GPU or shard]")] = None,
    address: Annotated[str | None, typer.Option(help="of a Ray cluster, 'auto' for the running one")] = None,
    slurm: Annotated[list[str] | None, typer.Option(help="KEY=VALUE for submitit, slurm_partition=gpu")] = None,
    shard_index: Annotated[int, typer.Option(help="make only every n-th shard, from this one on")] = 0,
    num_shards: Annotated[int, typer.Option(help="the n of --shard-index: how many runs share the work")] = 1,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="say what would be made, and how long it takes")] = False,
    **settings: Any,
) -> None:
    """Bakes a bank: a folder of HDF5 files that any trainer reads. Run it again to go on where it stopped.

    The same settings give the same bytes, whatever the engine and however often it was stopped.

    \b
    Examples:
      lidar-synth bake bank --count 20000 --seed 1 --engine processes
      lidar-synth bake bank --config bake_town --dry-run
      lidar-synth bake bank --count 1000000 --device cuda --engine ray --address auto --workers 8
      lidar-synth bake bank --model semantic.safetensors --condition SemanticKITTI --condition-split train
      lidar-synth bake bank --count 100000 --shard-index 2 --num-shards 4
      torchrun --nproc-per-node 8 -m lidar_synth bake bank --count 100000 --device cuda --engine torchrun
    """
    from lidar_synth.bake import Share, make_plan
    from lidar_synth.bake import bake as run
    from lidar_synth.train.config import read_values, validated

    values = {} if config is None else read_values(config, BakeJob)
    values |= {name: value for name, value in settings.items() if value is not None}
    share = Share(shard_index, num_shards)
    plan = make_plan(out, validated(BakeJob, values, "bake" if config is None else str(config)))
    if dry_run:
        _describe(plan)
        return
    quiet = os.environ.get("LOCAL_RANK", "0") != "0"
    try:
        index = run(plan, engine, _resources(plan, workers, address, slurm), share, progress=not quiet)
    except KeyboardInterrupt:
        typer.echo(f"stopped; finished shards are kept in {out}, and the same command goes on", err=True)
        raise typer.Exit(1) from None
    if index is None:
        typer.echo(f"{out}: this part is made; the index will be written when all {len(plan.shards)} shards are there")
    else:
        typer.echo(f"{out}: {index.scans} scans in {len(index.shards)} shards, {index.size / 1e6:.3g} MB")


def _resources(plan: "BakePlan", workers: int | None, address: str | None, slurm: list[str] | None) -> "Resources":
    import torch

    from lidar_synth.bake import Resources
    from lidar_synth.errors import ConfigError

    options: dict[str, Any] = {}
    for item in slurm or ():
        key, equals, value = item.partition("=")
        if not (key and equals):
            raise ConfigError(f"--slurm {item!r}", "KEY=VALUE, such as slurm_partition=gpu")
        options[key] = int(value) if value.isdigit() else value
    here = torch.cuda.device_count() if plan.job.device == "cuda" else os.cpu_count()
    return Resources(workers if workers is not None else here or 1, address, options)


def _describe(plan: "BakePlan") -> None:
    """What a bake would make; the time by trying."""
    from lidar_synth.bake.estimate import estimate

    job, shards = plan.job, plan.shards
    found = estimate(plan)
    typer.echo(f"{plan.out}: {job.count} scans in {len(shards)} shards of up to {job.shard_size}")
    typer.echo(f"  model {plan.facts.model} {plan.facts.checkpoint[:12]}, sensor {plan.facts.sensor.name}")
    typer.echo(f"  carried: range, {', '.join(plan.facts.fields)}; label policy {plan.facts.label_policy}")
    typer.echo(f"  about {found.bytes / 1e6:.3g} MB, {found.bytes / job.count / 1e3:.0f} kB a scan")
    typer.echo(f"  about {found.seconds / 60:.1f} minutes by one worker here, {job.count / found.seconds:.2f} scans/s")
