"""``lidar-synth edit``: removes objects from scans, sets them into scans and moves them."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lidar_synth.cli.options import Format, Out, Source

if TYPE_CHECKING:
    from lidar_synth.geometry.scan import Scan

edit = typer.Typer(
    name="edit",
    help="Surgery on scans: remove, insert and move objects with their boxes.",
    no_args_is_help=True,
)

Model = Annotated[
    str | None,
    typer.Option(
        help="model that draws the holes, for instance town [none: filled by geometry]"
    ),
]
Seed = Annotated[int, typer.Option(min=0, help="seed of the model's noise")]
ScanNumber = Annotated[int, typer.Option(min=0, help="number of the scan in IN")]
Place = Annotated[
    str,
    typer.Option(
        metavar="X,Y[,YAW]",
        help="metres, and degrees; without a yaw the recorded side faces the sensor",
    ),
]


@edit.command("remove")
def remove_objects(
    source: Source,
    out: Out,
    box: Annotated[
        list[int] | None, typer.Option(help="number of a box; repeatable")
    ] = None,
    name: Annotated[
        list[str] | None,
        typer.Option(help="remove all boxes of this class, for instance Car"),
    ] = None,
    scan: Annotated[
        int | None, typer.Option(min=0, help="number of the scan in IN [all]")
    ] = None,
    model: Model = None,
    seed: Seed = 0,
    to: Format = "npz",
) -> None:
    """Removes objects by their boxes, and fills the holes with what is behind them.

    \b
    Examples:
      lidar-synth edit remove KITTI out --name Car --to kitti_object
      lidar-synth edit remove town out --scan 0 --box 3 --model town
    """
    from lidar_synth.errors import ConfigError
    from lidar_synth.formats import open_scans
    from lidar_synth.labels.edit import remove

    if bool(box) == bool(name):
        raise ConfigError(f"--box {box}, --name {name}", "one of the two")
    scans = open_scans(source)
    count = 0
    chosen = range(len(scans)) if scan is None else [_number(scan, len(scans))]
    with _writing(out, to) as writer:
        writer.carry(scans)
        for index in chosen:
            given = scans[index]
            numbers = list(box or ()) if not name else _named(given, name)
            edited = given
            if numbers:
                edited = remove(given, numbers, model=model, seed=seed)
            count += len(numbers)
            calibration = scans.calibration(index)
            writer.write(edited, index, name=given.id, calibration=calibration)
    if name and not count:
        raise ConfigError(
            f"--name {', '.join(name)}",
            "the class of some box in these scans, such as KITTI's or the town's",
        )
    print(f"{out}: {count} objects removed")


@edit.command("insert")
def insert_object(
    source: Source,
    out: Out,
    objects: Annotated[
        Path, typer.Option(help="a bank of objects, .npz, of ObjectBank.save")
    ],
    at: Place,
    number: Annotated[
        int, typer.Option(min=0, help="number of the object in the bank")
    ] = 0,
    scan: ScanNumber = 0,
    to: Format = "npz",
) -> None:
    """Sets an object of a bank into one scan, with its box and with occlusion.

    \b
    Example:
      lidar-synth edit insert town out --objects objects.npz --number 12 --at 14,-3
    """
    from lidar_synth.errors import ConfigError
    from lidar_synth.labels import ObjectBank
    from lidar_synth.labels.edit import insert

    bank = ObjectBank.load(objects)
    if number >= len(bank):
        raise ConfigError(f"--number {number} of {bank}", f"0 to {len(bank) - 1}")
    _edit_one(
        source, out, scan, to, lambda given: insert(given, bank[number], _pose(at))
    )


@edit.command("move")
def move_object(
    source: Source,
    out: Out,
    box: Annotated[int, typer.Option(min=0, help="number of the box")],
    at: Place,
    scan: ScanNumber = 0,
    model: Model = None,
    seed: Seed = 0,
    to: Format = "npz",
) -> None:
    """Moves an object of one scan to another place, and fills the hole that it leaves.

    \b
    Example:
      lidar-synth edit move KITTI out --scan 5 --box 2 --at 18,4,90 --to kitti_object
    """
    from lidar_synth.labels.edit import move

    _edit_one(
        source,
        out,
        scan,
        to,
        lambda given: move(given, box, _pose(at), model=model, seed=seed),
    )


def _edit_one(source: str, out: Path, number: int, to: str, change: Any) -> None:
    from lidar_synth.formats import open_scans

    scans = open_scans(source)
    given = scans[_number(number, len(scans))]
    edited = change(given)
    calibration = scans.calibration(number)
    with _writing(out, to) as writer:
        writer.carry(scans)
        writer.write(edited, number, name=given.id, calibration=calibration)
    box = edited.boxes.values[-1]
    inside = int(edited.boxes.contain(edited.points)[-1].sum())
    print(
        f"{out}: {edited.boxes.names[-1]} at {box[0]:.1f}, {box[1]:.1f} m with {inside} points in "
        "its box"
    )


@contextmanager
def _writing(out: Path, to: str) -> Iterator[Any]:
    """The writer of a folder that no other process writes meanwhile, which is finished at the
    end; several edits may share a folder."""
    from lidar_synth.errors import choose
    from lidar_synth.files.claims import hold_claim
    from lidar_synth.formats import WRITERS

    writer = choose("--to", to, WRITERS)(out)
    with hold_claim(writer.root / ".edit.json", {"format": to}):
        yield writer
        writer.finish()


def _number(scan: int, count: int) -> int:
    from lidar_synth.errors import ConfigError

    if scan >= count:
        raise ConfigError(f"--scan {scan} of {count}", f"0 to {count - 1}")
    return scan


def _named(scan: "Scan", names: list[str]) -> list[int]:
    """The numbers of the boxes with some names; none in a scan without boxes, as in KITTI's
    ``testing``."""
    if scan.boxes is None:
        return []
    return [i for i, name in enumerate(scan.boxes.names) if name in names]


def _pose(text: str) -> list[float]:
    """x, y and, if given, yaw in radians."""
    from math import radians

    from lidar_synth.errors import ConfigError

    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) not in (2, 3):
        raise ConfigError(
            f"--at {text}",
            "X,Y in metres, or X,Y,YAW with degrees, for instance 14,-3 or 14,-3,90",
        )
    return [*values[:2], *map(radians, values[2:])]
