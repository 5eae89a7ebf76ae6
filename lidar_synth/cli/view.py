"""``lidar-synth view``: shows scans."""

from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument, Option, echo

from lidar_synth.cli.convert import InputSensor
from lidar_synth.cli.options import Reading, drop_missing, local_path, options_from
from lidar_synth.errors import ConfigError

if TYPE_CHECKING:
    from lidar_synth.formats import ScanFiles
    from lidar_synth.geometry import Scan


@options_from(Reading, after="sensor")
def view(
    path: Annotated[
        str,
        Argument(
            metavar="PATH",
            help="file, folder, root of a dataset, or bank, also its URL",
        ),
    ],
    index: Annotated[
        int, Option(help="number of the first scan, from 0; -1 is the last one")
    ] = 0,
    count: Annotated[int, Option(min=1, max=256, help="number of scans")] = 1,
    out: Annotated[
        Path | None,
        Option(
            help="file to write: .png (sheet) or .html (interactive page)",
            parser=local_path,
        ),
    ] = None,
    sensor: InputSensor = None,
    **reading: Any,
) -> None:
    """Shows scans as range image, bird's-eye view and 3-D points.

    Without --out a window opens if there is a screen; otherwise a page is written to the current
    folder.

    \b
    Examples:
      lidar-synth view scan.bin
      lidar-synth view kitti/ --index 7 --out scan.png
      lidar-synth view streets/ --count 16 --out streets.html
      lidar-synth view logs/ --sensor fitted.yaml --reflectance-max 255
    """
    from lidar_synth.formats import open_scans
    from lidar_synth.viz import show, view_suffix, write_view

    if out is not None:
        view_suffix(out)
    scans = _read(
        open_scans(path, sensor=sensor, **drop_missing(reading)), index, count
    )
    if out is None:
        if show(scans, title=path):
            return
        out = Path(f"{Path(path).resolve().stem or 'scans'}-{index}.html")
    write_view(out, scans, title=Path(path).resolve().name)
    echo(f"{out}: {len(scans)} of the scans in {path}")


def _read(source: "ScanFiles", index: int, count: int) -> "list[Scan]":
    """Read scans ``index``, ``index`` + 1, ... of a source, without those that are skipped.

    Raises:
        ConfigError: if the index is out of range.
    """
    from tqdm import tqdm

    first = index + len(source) if index < 0 else index
    if not 0 <= first < len(source):
        raise ConfigError(
            f"--index {index}: {source.root} holds {len(source)} scans",
            f"0 .. {len(source) - 1}",
        )
    count = min(count, len(source) - first)
    read = map(source.load_or_skip, range(first, len(source)))
    found = islice((scan for scan in read if scan is not None), count)
    return list(tqdm(found, "reading", count, unit="scan", disable=count < 8))
