"""The whole way of a scan on one machine, in about a minute.

    python tools/demo.py demo_out --scans 24

Writes a small town in KITTI-360's layout, reads it back as a user's own dataset would be read, puts every scan on the
sensor's grid and back, converts the dataset to SemanticKITTI's layout, and leaves one page to look at. The dataset is
the procedural town, not KITTI-360. Running it again goes on where it stopped.
"""

import argparse
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from tqdm import tqdm

from lidar_synth import Scan, open_scans, project, unproject
from lidar_synth.classes import NAMES
from lidar_synth.viz import write_view

SHOWN = 6


def command(*words: str) -> None:
    """Runs the command line as a user would, and says so."""
    print(f"\n$ lidar-synth {' '.join(words)}", flush=True)
    subprocess.run([sys.executable, "-m", "lidar_synth", *words], check=True)


def there_and_back(scans: list[Scan]) -> str:
    """Puts every scan on the grid and back; a sentence on what was seen."""
    filled, points, seen = [], [], np.zeros(len(NAMES), int)
    for scan in tqdm(scans, desc="project", unit="scan"):
        image = project(scan)
        again = project(unproject(image))
        if not np.array_equal(again.mask, image.mask):
            raise AssertionError(f"{scan.id}: a cell did not return to itself")
        filled.append(image.mask.mean())
        points.append(len(scan))
        if scan.label is not None:
            seen += np.bincount(scan.label[scan.label < len(NAMES)], minlength=len(NAMES))
    most = [NAMES[i] for i in np.argsort(-seen)[:5]]
    return (
        f"{len(scans)} scans of {np.mean(points):,.0f} points on average fill {100 * np.mean(filled):.0f} % of the "
        f"{scans[0].sensor.shape[0]} x {scans[0].sensor.columns} cells; every cell returned to itself. "
        f"{np.count_nonzero(seen)} of the {len(NAMES)} classes occur, most of all {', '.join(most)}."
    )


def main() -> None:
    """Runs all steps."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, nargs="?", default=Path("demo_out"), help="folder to write to")
    parser.add_argument("--scans", type=int, default=24, help="how many scans the town has")
    parser.add_argument("--seed", type=int, default=0, help="another town")
    given = parser.parse_args()
    start = time.monotonic()
    town, page = given.out / "town", given.out / "index.html"
    command("doctor")
    wanted = ("--scans", str(given.scans), "--seed", str(given.seed), "--layout", "kitti360")
    command("town", str(town), *wanted, "--jobs", str(os.cpu_count() or 1))
    source = open_scans(town)
    found = there_and_back([source[i] for i in range(len(source))])
    print(found)
    command("convert", str(town), str(given.out / "semantic_kitti"), "--to", "semantic_kitti")
    chosen = np.unique(np.linspace(0, len(source) - 1, SHOWN).astype(int))
    notes = f"Scans of the procedural town, written and read in KITTI-360's layout; it is not KITTI-360.\n\n{found}"
    write_view(page, [source[int(i)] for i in chosen], title="The town", notes=notes)
    print(f"\n{time.monotonic() - start:.0f} s. Look at {page.resolve()}")


if __name__ == "__main__":
    main()
