"""Shared parts of the conversion tests: the command as an application, and a KITTI odometry
sequence."""

from pathlib import Path

import typer
from layouts import some_scan, write_all

from lidar_synth.cli.convert import convert

app = typer.Typer()
"""``lidar-synth convert`` alone."""
app.command()(convert)


def a_sequence(
    root: Path, *, tr: bool = True, calib: bool = True, times: bool = True
) -> Path:
    """Three scans in KITTI's own odometry layout, with side files as they are there: F lines, exact
    text."""
    source = root / "sequences" / "07"
    write_all("semantic_kitti", root, [some_scan(i) for i in range(3)], sequence="07")
    [path.unlink() for path in source.glob("*.txt")]
    rows = [
        [700.0 + i, 0, 600, 5 * i, 0, 700, 180, 0.2, 0, 0, 1, 0.005] for i in range(4)
    ]
    lines = [f"P{i}: {' '.join(f'{v:.9e}' for v in row)}" for i, row in enumerate(rows)]
    lines += ["Tr: 0 -1 0 0.05 0 0 -1 -0.08 1 0 0 -0.27"] if tr else []
    if calib:
        (source / "calib.txt").write_text("\n".join(lines) + "\n")
    if times:
        (source / "times.txt").write_text("0.000000e+00\n1.037359e-01\n2.073381e-01\n")
    (source / "poses.txt").write_text(
        "".join(f"1 0 0 {i} 0 1 0 0 0 0 1 {i / 3!r}\n" for i in range(3))
    )
    return source
