"""``lidar-synth view``: look at scans."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lidar_synth.errors import ConfigError

if TYPE_CHECKING:
    from lidar_synth.geometry.scan import Scan


def view(
    path: Annotated[Path, typer.Argument(help="a file, a folder, a dataset's root or a bank")],
    index: Annotated[int, typer.Option(help="which scan, from 0; -1 is the last")] = 0,
    count: Annotated[int, typer.Option(min=1, max=256, help="how many, from there on")] = 1,
    out: Annotated[Path | None, typer.Option(help="a .png (sheet) or .html (interactive page) to write")] = None,
    sensor: Annotated[str | None, typer.Option(help="a preset's name or a YAML file")] = None,
) -> None:
    """Shows scans: range image, bird's-eye view and 3-D.

    Without --out a window opens where there is a screen; elsewhere a page is written into the current folder.

    \b
    Examples:
      lidar-synth view scan.bin
      lidar-synth view kitti/ --index 7 --out scan.png
      lidar-synth view town/ --count 16 --out town.html
    """
    from lidar_synth.viz import show, view_suffix, write_view

    if out is not None:
        view_suffix(out)
    scans = _read(path, index, count, sensor)
    if out is None:
        if show(scans, title=str(path)):
            return
        out = Path(f"{path.resolve().stem or 'scans'}-{index}.html")
    write_view(out, scans, title=path.resolve().name)
    typer.echo(f"{out}: {len(scans)} of the scans in {path}")


def _read(path: Path, index: int, count: int, sensor: str | None) -> "list[Scan]":
    """Scans index, index + 1 .. of what is at the path.

    Raises:
        ConfigError: if the index leads outside.
    """
    from tqdm import tqdm

    from lidar_synth.formats import open_scans

    source = open_scans(path, sensor=sensor)
    first = index + len(source) if index < 0 else index
    if not 0 <= first < len(source):
        raise ConfigError(f"--index {index}: {path} holds {len(source)} scans", f"0 .. {len(source) - 1}")
    chosen = range(first, min(first + count, len(source)))
    return [source[i] for i in tqdm(chosen, "reading", unit="scan", disable=len(chosen) < 8)]
