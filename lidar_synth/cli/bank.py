"""``lidar-synth verify``, ``repair``, ``info`` and ``bank``: maintenance of banks."""

from contextlib import suppress
from pathlib import Path
from typing import Annotated

from typer import Argument, Exit, Option, Typer, echo

from lidar_synth.cli.options import Json, drop_missing, local_path

BankFolder = Annotated[str, Argument(metavar="BANK", help="folder or URL of a bank")]
Model = Annotated[
    str | None, Option(help="checkpoint file, if it is not a shipped model")
]
Condition = Annotated[
    str | None, Option(help="dataset of the conditions, if it has moved")
]
Out = Annotated[
    Path,
    Argument(metavar="OUT", help="folder of the new bank", parser=local_path),
]


def verify(
    bank: BankFolder,
    deep: Annotated[
        bool,
        Option(
            "--deep", help="also regenerate some scans from their seeds and compare"
        ),
    ] = False,
    sample: Annotated[
        int | None, Option(min=1, help="number of scans that --deep regenerates [16]")
    ] = None,
    seed: Annotated[
        int | None, Option(min=0, help="seed that selects these scans [random]")
    ] = None,
    model: Model = None,
    condition: Condition = None,
) -> None:
    """Checks a bank: index, every shard's hash and attributes, every scan, and the card. Exit
    status 1 = damaged.

    \b
    Examples:
      lidar-synth verify bank
      lidar-synth verify bank --deep --model runs/student/student.safetensors
      lidar-synth verify bank --deep --sample 100 --seed 7
    """
    import secrets
    from shlex import quote

    from lidar_synth.bake.verify import AGREE, UNLISTED, regenerate, verify as run
    from lidar_synth.errors import ConfigError

    options = {"sample": sample, "seed": seed, "model": model, "condition": condition}
    if not deep and (given := drop_missing(options)):
        raise ConfigError(f"--{' and --'.join(given)} without --deep", "--deep as well")
    problems = run(bank)
    for problem in problems:
        echo(f"{problem.file}: {problem.what}", err=True)
    if problems:
        echo(f"{bank}: {len(problems)} problems")
        if any(problem.what != UNLISTED for problem in problems):
            echo(f"lidar-synth repair {quote(bank)} regenerates what a model has made.")
        raise Exit(1)
    echo(f"{bank}: intact")
    if not deep:
        return
    seed = secrets.randbits(32) if seed is None else seed
    echo(f"{bank}: scans selected by --seed {seed}")
    shares = regenerate(bank, model, sample or 16, seed=seed, condition=condition)
    different = {name: share for name, share in shares.items() if share < AGREE}
    for name, share in different.items():
        echo(
            f"{name}: {share:.1%} of its cells agree with the regenerated scan",
            err=True,
        )
    echo(
        f"{bank}: {len(shares)} scans regenerated, at least {min(shares.values()):.2%} of the "
        "cells agree"
    )
    if different:
        raise Exit(1)


def repair(bank: BankFolder, model: Model = None, condition: Condition = None) -> None:
    """Regenerates exactly the damaged or missing shards of a bank, and rewrites a damaged index or
    card.

    On the machine and with the versions that made the bank, the bytes are the same; elsewhere the
    scans are equal up to rounding, and the index records the repair.

    \b
    Examples:
      lidar-synth repair bank
      lidar-synth repair bank --model runs/student/student.safetensors
    """
    from lidar_synth.bake.repair import repair as run

    done = run(bank, model, condition=condition)
    for file, what in done.items():
        echo(f"{file}: {what}")
    if not done:
        echo(f"{bank}: intact, nothing to do")


def info(bank: BankFolder, as_json: Json = False) -> None:
    """Describes a bank: scans, sensor, model, settings, licences.

    \b
    Examples:
      lidar-synth info bank
      lidar-synth info s3://bucket/bank --json
    """
    import json

    from lidar_synth.bank import Bank
    from lidar_synth.bank.card import summary

    values = summary(Bank(bank).index)
    if as_json:
        echo(json.dumps(values, indent=1))
        return
    for name, value in values.items():
        echo(f"{name:<14}{value}")


def merge(
    out: Out,
    banks: Annotated[
        list[str],
        Argument(metavar="BANK...", help="banks with the same sensor and fields"),
    ],
) -> None:
    """Merges several banks into one. Shards are hard-linked instead of copied where the file system
    allows it.

    \b
    Example:
      lidar-synth bank merge all part-0 part-1 s3://bucket/part-2
    """
    from lidar_synth.bake.edit import merge as run
    from lidar_synth.bank import Bank

    index = run([Bank(path) for path in banks], out)
    echo(f"{out}: {index.scans} scans in {len(index.shards)} shards")


def split(
    bank: BankFolder,
    parts: Annotated[
        list[str],
        Argument(
            metavar="FOLDER=SHARE...",
            help="folders, each with its share of the scans; the shares sum to 1",
        ),
    ],
) -> None:
    """Splits a bank into consecutive parts.

    \b
    Example:
      lidar-synth bank split bank train=0.9 val=0.1
    """
    from lidar_synth.bake.edit import split as run
    from lidar_synth.bank import Bank
    from lidar_synth.errors import ConfigError

    shares: dict[Path, float] = {}
    for count, part in enumerate(parts):
        folder, _, share = part.rpartition("=")
        with suppress(ValueError):
            shares[local_path(folder)] = float(share)
        if not folder or len(shares) == count:
            raise ConfigError(
                f"part {part!r}", "FOLDER=SHARE, such as train=0.9, each folder once"
            )
    for out, index in run(Bank(bank), shares).items():
        echo(f"{out}: {index.scans} scans in {len(index.shards)} shards")


def head(
    bank: BankFolder,
    out: Out,
    count: Annotated[int, Option(help="number of scans")] = 100,
) -> None:
    """Makes a bank from the first scans of another one.

    \b
    Example:
      lidar-synth bank head bank small --count 1000
    """
    from lidar_synth.bake.edit import head as run
    from lidar_synth.bank import Bank

    index = run(Bank(bank), count, out)
    echo(f"{out}: {index.scans} scans in {len(index.shards)} shards")


def as_sensor(
    bank: BankFolder,
    out: Out,
    sensor: Annotated[
        str, Option(help="sensor of the new bank: a preset or a YAML file")
    ],
    mount: Annotated[
        str | None,
        Option(
            metavar="Z,PITCH", help="metres higher, degrees looking further down [0,0]"
        ),
    ] = None,
    like: Annotated[
        Path | None,
        Option(help="real scans of that sensor, to match its reflectance"),
    ] = None,
    range_noise: Annotated[
        float, Option(help="metres, noise beyond that of the bank")
    ] = 0.0,
    reach: Annotated[
        float | None,
        Option(
            help="metres at which it loses every second ray to a surface of 10 % reflectance"
        ),
    ] = None,
) -> None:
    """Makes a bank of the scans as another sensor would have recorded them, once instead of in
    every epoch.

    Run it again to resume an interrupted run, or to make damaged shards again.

    \b
    Example:
      lidar-synth bank as-sensor bank as_hdl32e --sensor hdl32e_nuscenes --like nuscenes
    """
    from lidar_synth.bake.as_sensor import turn_bank
    from lidar_synth.bank import Bank
    from lidar_synth.cli.convert import read_mount
    from lidar_synth.formats.as_sensor import make_transfer

    source = Bank(bank)
    transfer = make_transfer(
        sensor, read_mount(mount), like, source, range_noise=range_noise, reach=reach
    )
    index = turn_bank(source, out, transfer)
    echo(f"{out}: {index.scans} scans in {len(index.shards)} shards")


bank = Typer(
    name="bank",
    help="Makes new banks from existing ones: merge, split, head, as-sensor.",
    no_args_is_help=True,
)
for _command in (merge, split, head, as_sensor):
    bank.command()(_command)
