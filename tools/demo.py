"""The whole package in a few minutes on one machine: real scans mixed with synthetic ones, a training, a page of scans.

    python tools/demo.py demo_out --scans 24

1. Writes a small procedural town in SemanticKITTI's layout, in place of your own dataset. With SEMANTICKITTI_ROOT set,
   that dataset is used instead. With KITTI360_ROOT, which has no labels per scan, scans are mixed and shown, but
   nothing is trained.
2. Mixes it with 4-step scans that the shipped model generates in two DataLoader workers, one sample in four, and trains
   a small segmenter for a few steps.
3. Bakes a bank of synthetic scans, verifies it, and mixes scans of the bank.
4. Writes one page with real and synthetic samples.

Run it again to resume after a stop.
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
    """Prints a command of ``lidar-synth`` and runs it as a user would."""
    print(f"\n$ lidar-synth {' '.join(words)}", flush=True)
    subprocess.run([sys.executable, "-m", "lidar_synth", *words], check=True)


def dataset(out: Path, scans: int, seed: int) -> tuple[Source, str, bool]:
    """The user's own scans, a description, and whether they have labels."""
    if root := os.environ.get("SEMANTICKITTI_ROOT"):
        return open_scans(root, layout="semantic_kitti", split="train"), "SemanticKITTI", True
    if root := os.environ.get("KITTI360_ROOT"):
        return open_scans(root, layout="kitti360", split="r2flow/train"), "KITTI-360", False
    town = out / "town"
    wanted = ("--scans", str(scans), "--seed", str(seed), "--layout", "semantic_kitti")
    command("town", str(town), *wanted, "--jobs", str(os.cpu_count() or 1))
    return open_scans(town), "the procedural town", True


def train(real: Source, synthetic: object, steps: int) -> str:
    """Train briefly on the mixture; returns a sentence about the loss."""
    mixed = MixedScans(real, synthetic, RATIO, labels="generated", balanced=True, collate="range")
    height = torch.from_numpy(np.sin(mixed.collate.sensor.ray_angles()[0]))
    torch.manual_seed(0)
    losses = train_segmenter(RangeSegmenter(), endless_batches(mixed, BATCH, WORKERS), height, steps)
    share = sum(mixed.domain(i) for i in range(len(mixed))) / len(mixed)
    return (
        f"A segmenter was trained on {steps} batches of {BATCH}, {100 * share:.0f} % of the scans synthetic; "
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
    parser.add_argument("--seed", type=int, default=0, help="seed of the town")
    given = parser.parse_args()
    start = time.monotonic()
    command("doctor")
    real, name, labelled = dataset(given.out, given.scans, given.seed)
    labels = "generated" if labelled else "none"
    generator = load_generator("town")
    result = (
        train(real, generator, steps=2 * given.scans) if labelled else "Nothing was trained: the scans have no labels."
    )
    print(result)
    bank = given.out / "bank"
    command("bake", str(bank), "--model", "town", "--count", str(given.scans), "--seed", "1", "--shard-size", "16")
    command("verify", str(bank), "--deep")
    shown = samples(real, generator, labels, 6) + samples(real, Bank(bank), labels, 4)[-2:]
    page = given.out / "index.html"
    notes = f"Real scans: {name}. Synthetic scans: the model that comes with the package, in 4 steps.\n\n{result}"
    write_view(page, shown, title="Real and synthetic scans", notes=notes)
    print(f"\n{time.monotonic() - start:.0f} s. The page is {page.resolve()}")


if __name__ == "__main__":
    main()
