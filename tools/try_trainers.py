"""Run each trainer's own script on a mixture, in a fresh environment, with validation; print a
Markdown table.

    python tools/try_trainers.py --work FOLDER [--only NAME] [--scans 1]

``tools/trainers/`` has one file for each trainer. Public source trees are found by environment
variables such as OPENPCDET_ROOT and POINTCEPT_ROOT; each file names its own. Real scans are used
where LIDAR_SYNTH_LABELLED_SCANS and LIDAR_SYNTH_REAL_SCANS name their folders, beside scans of the
town. Logs are kept in FOLDER/<name>/logs. This shows that a trainer runs on the mixture, not that
the mixture helps. The exit status is 1 if a trial failed.
"""

import importlib
import os
import platform
import shutil
import sys
import traceback
from pathlib import Path
from typing import Annotated

from trainers.data import Data
from trainers.trial import STEPS, Failed, Row, Trial
from typer import Option, run

FRAME = ("__init__", "data", "trial")


def names() -> list[str]:
    """The trainers that have a file."""
    return sorted(
        path.stem
        for path in (Path(__file__).parent / "trainers").glob("*.py")
        if path.stem not in FRAME
    )


def attempt(name: str, work: Path, data: Data, reuse: bool) -> list[Row]:
    """The rows of a trainer; a failure is the last of them."""
    module = importlib.import_module(f"trainers.{name}")
    trial = Trial(name, module.TITLE, work, data, reuse)
    done: list[Row] = []
    try:
        for row in module.rows(trial):
            done.append(row)
            print(line(row), file=sys.stderr, flush=True)
    except Exception as error:  # one trainer's failure must not stop the others
        if not isinstance(error, Failed):
            traceback.print_exc()
        text = " ".join(str(error).split()) or type(error).__name__
        done.append(trial.row("", (), f"**failed**: {text}", failed=True))
        print(line(done[-1]), file=sys.stderr, flush=True)
    return done


def line(row: Row) -> str:
    """A row in Markdown."""
    script = f"`{row.script}`" if row.script else ""
    marks = ["yes" if step in row.ran else "no" for step in STEPS]
    cells = [
        row.trainer,
        script,
        *marks,
        row.left_out.replace("|", "\\|"),
        f"{row.minutes:.1f}",
    ]
    return f"| {' | '.join(cells)} |"


def main(
    work: Annotated[Path, Option()],
    only: list[str] | None = None,
    scans: int = 1,
    reuse_environments: bool = False,
) -> None:
    """Runs the trials, by default all, and prints the table."""
    work = work.absolute()
    shutil.rmtree(work / "wheel", ignore_errors=True)  # that of an earlier checkout
    data = Data(work / f"data-{scans}", scans)
    done: list[Row] = []
    for name in only or names():
        done += attempt(name, work, data, reuse_environments)
    machine = f"Python {platform.python_version()}, {os.cpu_count()} cores, {platform.machine()}"
    print(f"{machine}; scans called real: {data.real}\n")
    print(
        f"| trainer | script | {' | '.join(STEPS)} | not on a CPU | minutes "
        f"|\n|{'---|' * (len(STEPS) + 3)}---:|"
    )
    print("\n".join(line(row) for row in done))
    sys.exit(any(row.failed for row in done))


if __name__ == "__main__":
    run(main)
