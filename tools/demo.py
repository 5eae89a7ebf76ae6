"""The main job on one machine, in a few minutes: real scans, synthetic ones among them, a training, a page to look at.

    python tools/demo.py demo_out --scans 24

1. Writes a small town in SemanticKITTI's layout: it stands for your own dataset (it is no one's recording). With
   SEMANTICKITTI_ROOT set, that dataset is used instead; with KITTI360_ROOT, which has no labels per scan, scans are
   mixed and shown, and nothing is trained.
2. Mixes it with 4-step scans that the shipped model makes on the fly, one sample in four, in two DataLoader workers,
   and trains a small segmenter on that for a moment.
3. Bakes a bank of synthetic scans, verifies it, and mixes from the bank.
4. Leaves one page with real and synthetic samples.

Running it again goes on where it stopped.
"""

import argparse
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import torch

from lidar_synth import Bank, MixedScans, Scan, Source, load_generator, open_scans
from lidar_synth.models.segmenter import RangeSegmenter
from lidar_synth.train.segmentation import endless_batches, train_segmenter
from lidar_synth.viz import write_view

RATIO = 0.25
BATCH = 4
WORKERS = 2


def command(*words: str) -> None:
    """Runs the command line as a user would, and says so."""
    print(f"\n$ lidar-synth {' '.join(words)}", flush=True)
    subprocess.run([sys.executable, "-m", "lidar_synth", *words], check=True)


def dataset(out: Path, scans: int, seed: int) -> tuple[Source, str, bool]:
    """The user's own scans, what they are, and whether they have labels."""
    if root := os.environ.get("SEMANTICKITTI_ROOT"):
        return open_scans(root, layout="semantic_kitti", split="train"), "SemanticKITTI", True
    if root := os.environ.get("KITTI360_ROOT"):
        return open_scans(root, layout="kitti360", split="r2flow/train"), "KITTI-360", False
    town = out / "town"
    wanted = ("--scans", str(scans), "--seed", str(seed), "--layout", "semantic_kitti")
    command("town", str(town), *wanted, "--jobs", str(os.cpu_count() or 1))
    return open_scans(town), "the town (procedural; no one's recording)", True


def train(real: Source, synthetic: object, steps: int) -> str:
    """A short training on the mixture; a sentence on how it went."""
    mixed = MixedScans(real, synthetic, RATIO, labels="generated", balanced=True, collate="range")
    height = torch.from_numpy(np.sin(mixed.collate.sensor.ray_angles()[0]))
    torch.manual_seed(0)
    losses = train_segmenter(RangeSegmenter(), endless_batches(mixed, BATCH, WORKERS), height, steps)
    share = sum(mixed.domain(i) for i in range(len(mixed))) / len(mixed)
    return (
        f"A segmenter saw {steps} batches of {BATCH}, {100 * share:.0f} % of them synthetic; "
        f"its loss went from {losses[0]:.2f} to {np.mean(losses[-5:]):.2f}."
    )


def samples(real: Source, synthetic: object, labels: str, count: int) -> list[Scan]:
    """The first samples of a mixture, as scans."""
    mixed = MixedScans(real, synthetic, 0.5, labels=labels, balanced=True, to_sample=lambda scan, rng: scan)
    return [mixed[i] for i in range(min(count, len(mixed)))]


def main() -> None:
    """Runs all steps."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, nargs="?", default=Path("demo_out"), help="folder to write to")
    parser.add_argument("--scans", type=int, default=24, help="how many scans the town has")
    parser.add_argument("--seed", type=int, default=0, help="another town")
    given = parser.parse_args()
    start = time.monotonic()
    command("doctor")
    real, name, labelled = dataset(given.out, given.scans, given.seed)
    labels = "generated" if labelled else "none"
    generator = load_generator("town")
    found = train(real, generator, steps=2 * given.scans) if labelled else "Without labels there is no training."
    print(found)
    bank = given.out / "bank"
    command("bake", str(bank), "--model", "town", "--count", str(given.scans), "--seed", "1", "--shard-size", "16")
    command("verify", str(bank), "--deep")
    shown = samples(real, generator, labels, 6) + samples(real, Bank(bank), labels, 4)[-2:]
    page = given.out / "index.html"
    notes = f"Real scans: {name}. Synthetic scans: the model that comes with the package, in 4 steps.\n\n{found}"
    write_view(page, shown, title="Real and synthetic scans", notes=notes)
    print(f"\n{time.monotonic() - start:.0f} s. Look at {page.resolve()}")


if __name__ == "__main__":
    main()
