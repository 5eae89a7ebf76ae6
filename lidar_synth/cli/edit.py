"""``lidar-synth edit``: removes objects from scans, sets them into scans and moves them."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Context, Option, Typer

from lidar_synth.cli.convert import InputSensor, print_report, read_numbers
from lidar_synth.cli.options import (
    Format,
    Out,
    Reading,
    Source,
    drop_missing,
    options_from,
)

if TYPE_CHECKING:
    from lidar_synth.geometry import Scan

edit = Typer(
    name="edit",
    help="Surgery on scans: remove, insert and move objects with their boxes. A folder takes one "
    "edit of a scan.",
    no_args_is_help=True,
)

Model = Annotated[
    str | None,
    Option(
        help="model that draws the holes, for instance town [none: filled by geometry]"
    ),
]
Seed = Annotated[int, Option(min=0, help="seed of the model's noise")]
ScanNumber = Annotated[int, Option(min=0, help="number of the scan in IN")]
Place = Annotated[
    str,
    Option(
        metavar="X,Y[,YAW]",
        help="metres, and degrees; without a yaw the recorded side faces the sensor",
    ),
]


@edit.command("remove")
@options_from(Reading, after="sensor")
def remove_objects(
    context: Context,
    source: Source,
    out: Out,
    box: Annotated[list[int] | None, Option(help="number of a box; repeatable")] = None,
    name: Annotated[
        list[str] | None,
        Option(help="remove all boxes of this class, for instance Car"),
    ] = None,
    scan: Annotated[
        int | None, Option(min=0, help="number of the scan in IN [all, for --name]")
    ] = None,
    model: Model = None,
    seed: Seed = 0,
    to: Format = "npz",
    sensor: InputSensor = None,
    **reading: Any,
) -> None:
    """Removes objects by their boxes, and fills the holes with what is behind them.

    \b
    Examples:
      lidar-synth edit remove KITTI out --name Car --to kitti_object
      lidar-synth edit remove streets out --scan 0 --box 3 --model town --sensor hdl64e_lasers
    """
    from lidar_synth.errors import ConfigError
    from lidar_synth.labels.edit import remove

    if bool(box) == bool(name):
        raise ConfigError(f"--box {box}, --name {name}", "one of the two")
    count = 0

    def change(given: "Scan") -> "Scan":
        nonlocal count
        numbers = box or _named(given, name or [])
        count += len(numbers)
        return remove(given, numbers, model=model, seed=seed)

    _edit(context, change)
    print(f"{out}: {count} objects removed")


@edit.command("insert")
@options_from(Reading, after="sensor")
def insert_object(
    context: Context,
    source: Source,
    out: Out,
    objects: Annotated[str, Option(help="a bank of objects, .npz, of ObjectBank.save")],
    at: Place,
    number: Annotated[int, Option(min=0, help="number of the object in the bank")] = 0,
    scan: ScanNumber = 0,
    to: Format = "npz",
    sensor: InputSensor = None,
    **reading: Any,
) -> None:
    """Inserts an object of a bank into one scan, with its box and occlusion.

    \b
    Example:
      lidar-synth edit insert streets out --objects objects.npz --number 12 --at 14,-3
    """
    from lidar_synth.errors import ConfigError
    from lidar_synth.labels import ObjectBank
    from lidar_synth.labels.edit import insert

    bank = ObjectBank.load(objects)
    if number >= len(bank):
        raise ConfigError(f"--number {number} of {bank}", f"0 to {len(bank) - 1}")

    def change(given: "Scan") -> "Scan":
        return insert(given, bank[number], _pose(at))

    _print_last(out, _edit(context, change))


@edit.command("move")
@options_from(Reading, after="sensor")
def move_object(
    context: Context,
    source: Source,
    out: Out,
    box: Annotated[int, Option(min=0, help="number of the box")],
    at: Place,
    scan: ScanNumber = 0,
    model: Model = None,
    seed: Seed = 0,
    to: Format = "npz",
    sensor: InputSensor = None,
    **reading: Any,
) -> None:
    """Moves an object of one scan to another place, and fills the hole that it leaves.

    \b
    Example:
      lidar-synth edit move KITTI out --scan 5 --box 2 --at 18,4,90 --to kitti_object
    """
    from lidar_synth.labels.edit import move

    def change(given: "Scan") -> "Scan":
        return move(given, box, _pose(at), model=model, seed=seed)

    _print_last(out, _edit(context, change))


def _print_last(out: Path, edited: Any) -> None:
    """Where the last box of a scan is, which was set there."""
    box = edited.boxes.values[-1]
    inside = int(edited.boxes.contain(edited.points)[-1].sum())
    print(
        f"{out}: {edited.boxes.names[-1]} at {box[0]:.1f}, {box[1]:.1f} m with {inside} points in "
        "its box"
    )


def _edit(context: Context, change: Callable[["Scan"], Any]) -> Any:
    """Write one scan of a source, or all, as they are after a change; the last one.

    Several edits of single scans may share a folder, each of another scan: beside it stands the
    call that wrote it, which may be run again.

    Args:
        context: of the command, with its options.
        change: makes the edited scan.
    """
    from tqdm import tqdm

    from lidar_synth.bank.storage import settle_path
    from lidar_synth.errors import ConfigError, choose
    from lidar_synth.files.claims import claim
    from lidar_synth.formats import WRITERS, open_scans
    from lidar_synth.formats.convert import Report

    given = context.params
    number = given["scan"]
    writer = choose("--to", given["to"], WRITERS)(given["out"])
    reading = {key: given[key] for key in ("sensor", *Reading.model_fields)}
    scans = open_scans(given["source"], **drop_missing(reading))
    chosen = range(len(scans)) if number is None else [number]
    read = scans.load_or_skip if number is None else scans.load
    if chosen[-1] >= len(scans):
        raise ConfigError(f"--scan {number} of {len(scans)}", f"0 to {len(scans) - 1}")
    if names := given.get("name"):
        _require(names, filter(None, map(read, chosen)))
    if number is None and given.get("box") and len(scans) > 1:
        raise ConfigError(
            f"--box {given['box'][0]} of {len(scans)} scans",
            "--scan, the number of the scan that has these boxes",
        )
    paths: dict[str, Any] = {
        key: settle_path(given[key]) for key in ("source", "objects") if key in given
    }
    call = {"edit": context.info_name, **given, **paths, "out": None}
    of_all = call if number is None else dict.fromkeys(call)
    edited: Any = None
    with writer.hold(".edit.json", of_all | {"to": given["to"]}, scans):
        report = Report(0, 0, scans.skipped, scans.dropped, writer.carry(scans))
        for index in tqdm(chosen, "scans", unit="scan", disable=len(chosen) < 8):
            if (scan := read(index)) is None:
                continue
            edited = change(scan)
            if number is not None:
                claim(writer.root / f".edit-{index}.json", call)
            camera = scans.calibration(index)
            writer.write(edited, index, name=scans.ids[index], calibration=camera)
            report.add(writer, edited, camera)
        writer.finish()
    print_report(report, given["out"], given["to"])
    return edited


def _require(names: list[str], scans: Iterable["Scan"]) -> None:
    """Refuse names of classes of which no scan has a box."""
    from lidar_synth.errors import ConfigError

    there: set[str] = set()
    for scan in scans:
        there.update(scan.boxes.names if scan.boxes else ())
        if there.issuperset(names):
            return
    raise ConfigError(
        f"--name {', '.join(name for name in names if name not in there)}",
        f"the class of some box in these scans: {', '.join(sorted(there)) or 'none'}",
    )


def _named(scan: "Scan", names: list[str]) -> list[int]:
    """The numbers of the boxes with some names; none in a scan without boxes, as in KITTI's
    ``testing``."""
    if scan.boxes is None:
        return []
    return [i for i, name in enumerate(scan.boxes.names) if name in names]


def _pose(text: str) -> list[float]:
    """x, y and, if given, yaw in radians."""
    from math import radians

    expected = "X,Y in metres, or X,Y,YAW with degrees, for instance 14,-3 or 14,-3,90"
    values = read_numbers(f"--at {text}", text, (2, 3), expected)
    return [*values[:2], *map(radians, values[2:])]
