"""Does a detector gain from synthetic scans? Trained on 30 labelled scans of one town, tested on
two others.

    python tools/research/detector_trial.py WORK [--arm real --arm gt_sampling ...] [--seeds 3]
        [--iterations 1600] [--layout-model CHECKPOINT] [--minutes M] [--out TABLE.md]

All arms have the same network, iterations, augmentation (turned, mirrored, scaled) and test. Half
of each batch of an arm with synthetic scans is synthetic, unless its row says otherwise. Each seed
has its own 30 scans of the town, the same in every arm. Scans and finished trainings are kept in
WORK: the same command resumes. docs/research/detectors.md has the protocol.
"""

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import detector_pools as pools
import numpy as np
import torch
import typer
from torch import nn
from tqdm import tqdm

from lidar_synth import MixedScans, ObjectBank, Source, load_generator
from lidar_synth.files.disk import write_file
from lidar_synth.lab.proof.arms import EPOCHS
from lidar_synth.lab.proof.detection.bev import view
from lidar_synth.lab.proof.detection.boxes import CLASSES
from lidar_synth.lab.proof.detection.network import (
    Detector,
    collate,
    detect,
    sample,
    train,
)
from lidar_synth.lab.proof.detection.scores import Truth, precisions
from lidar_synth.lab.proof.machine import machine
from lidar_synth.lab.train.segmentation import endless_batches
from lidar_synth.mixing import Sources, SyntheticFirst
from lidar_synth.mixing.defaults import PASTED, augment_boxes

LABELLED = 30
TRAIN_TOWN = 7
TESTED = 40
TEST_TOWNS = (8, 9)
"""Tested scans of each town."""
LAYOUT_TOWNS = (20, 21)
UNBOXED_MODEL = "town"
BATCH = 2
RATE = 3e-3
BASE = "gt_sampling"
"""The arm with which the others are compared."""


Test = Callable[[nn.Module], list[float]]


@dataclass(frozen=True)
class Arm:
    """One of the compared trainings.

    Args:
        title: its row in the table.
        budget: the labels that it uses besides the 30 scans.
        pool: of the synthetic half of each batch, a name of ``Work.pool``; "" for none.
        labels: the label policy of these scans.
        pasted: whether objects of the 30 scans are pasted into all scans.
        first: whether its schedule is that of ``SyntheticFirst``.
        share: of synthetic scans in a batch.
    """

    title: str
    budget: str
    pool: str = ""
    labels: str = "boxes"
    pasted: bool = False
    first: bool = False
    share: float = 0.5


_MODEL = "the generator's: 6,000 scans of the town of seed 0 with point labels"
_LAYOUT = (
    "the generator's: 6,000 scans of the town of seed 0 with point labels and boxes; layouts of "
    "other towns"
)
_TOWN = "boxes of the town scans"
ARMS = {
    "real": Arm("labelled scans only", "none"),
    "gt_sampling": Arm("GT sampling", "none", pasted=True),
    "unboxed": Arm(
        "unconditional scans with unboxed objects, objects pasted",
        _MODEL,
        "unboxed",
        "paste",
    ),
    "closed": Arm(
        "unconditional scans without unboxed objects, objects pasted",
        _MODEL,
        "closed",
        "paste",
    ),
    "layout": Arm("layout scans", _LAYOUT, "layout"),
    "layout_gt": Arm("layout scans, GT sampling", _LAYOUT, "layout", pasted=True),
    "layout_quarter": Arm(
        "layout scans in a quarter, GT sampling",
        _LAYOUT,
        "layout",
        pasted=True,
        share=0.25,
    ),
    "town": Arm("town scans of the same layouts (upper bound)", _TOWN, "town"),
    "town_gt": Arm(
        "town scans of the same layouts, GT sampling (upper bound)",
        _TOWN,
        "town",
        pasted=True,
    ),
    "town_first": Arm(
        "these first, GT sampling (upper bound)", _TOWN, "town", pasted=True, first=True
    ),
}


class Work:
    """The folder of the trial: scans, and results of the trainings.

    Args:
        folder: where they are kept.
        iterations: of each training.
        count: number of synthetic scans of a pool.
        model: the layout model's checkpoint.
    """

    def __init__(
        self, folder: Path, iterations: int, count: int, model: str | None
    ) -> None:
        self.folder = folder
        self.iterations = iterations
        self.count = count
        self.model = model
        self.pool = cache(self._pool)

    @property
    def tag(self) -> str:
        """Names the layout model in files."""
        if self.model is None:
            raise SystemExit("arms with layout scans need --layout-model CHECKPOINT")
        return load_generator(self.model).hash[:8]

    def labelled(self, seed: int) -> Source:
        """The labelled scans of a seed."""
        return pools.streets(
            self.folder / "pools" / f"labelled-{seed}",
            TRAIN_TOWN,
            LABELLED * seed,
            LABELLED,
        )

    def tested(self) -> list[Source]:
        """The tested scans of each town."""
        return [
            pools.streets(
                self.folder / "pools" / f"test-{t}", t, 0, TESTED, every_box=True
            )
            for t in TEST_TOWNS
        ]

    def _pool(self, name: str) -> Source:
        folder = self.folder / "pools" / f"{name}-{self.count}"
        if name == "unboxed":
            return pools.unconditional(folder, self.count, UNBOXED_MODEL)
        if name == "closed":
            return pools.without_unboxed(folder, self.pool("unboxed"))
        if name == "layout":
            model = str(self.model)
            return pools.laid_out(
                folder.with_name(f"{name}-{self.tag}-{self.count}"),
                model,
                self.pool("town"),
            )
        towns = [folder.with_name(f"town-{t}-{self.count}") for t in LAYOUT_TOWNS]
        parts = [
            pools.streets(f, t, 0, self.count // 2)
            for f, t in zip(towns, LAYOUT_TOWNS, strict=True)
        ]
        return Sources(*parts)

    def result(self, arm: str, seed: int) -> Path:
        """The file of a finished training."""
        key = f"{arm}-{self.tag}" if ARMS[arm].pool == "layout" else arm
        return self.folder / f"runs-{self.iterations}" / f"{key}-{seed}.json"


def mixture(
    arm: Arm, labelled: Source, pool: Source | None, seed: int, epoch_size: int
) -> MixedScans:
    """The training set of an arm, as a user of the package makes it."""
    objects = ObjectBank.from_scans(labelled)
    there = {name: most for name, most in PASTED.items() if name in objects.boxes.names}
    options = {"bank": objects, "count": there, "turn": 180.0, "clear": False}
    share = SyntheticFirst(EPOCHS) if arm.first else arm.share
    return MixedScans(
        labelled,
        pool,
        share if pool is not None else 0,
        {"paste": options} if arm.labels == "paste" else arm.labels,
        seed=seed,
        balanced=True,
        epoch_size=epoch_size,
        augment=augment_boxes([objects] if arm.pasted else []),
        augment_real=True,
        to_sample=sample,
        collate=collate,
        # the pools are baked without unboxed objects, except the one that shows their harm
        unboxed="keep",
    )


def run(work: Work, name: str, seed: int, test: Test) -> dict[str, Any]:
    """Train and test one detector."""
    arm = ARMS[name]
    labelled = work.labelled(seed)
    pool = work.pool(arm.pool) if arm.pool else None
    start = time.process_time()
    torch.manual_seed(seed)
    network = Detector()
    epoch_size = BATCH * max(1, work.iterations // EPOCHS)
    mixed = mixture(arm, labelled, pool, seed, epoch_size)
    batches = endless_batches(mixed, BATCH)
    losses = train(network, batches, work.iterations, RATE, f"{name} {seed}")
    seconds = time.process_time() - start
    found = test(network)
    tenths = [part for part in np.array_split(losses, 10) if len(part)]
    return {
        "arm": name,
        "seed": seed,
        "ap": found,
        "losses": [round(float(part.mean()), 3) for part in tenths],
        "seconds": round(seconds, 1),
    }


def make_test(work: Work) -> Test:
    """The test of a network: average precision of every class on all tested scans."""
    scans = [source[i] for source in work.tested() for i in range(len(source))]
    truths = [Truth.of(scan) for scan in tqdm(scans, "tested boxes", unit="scan")]
    counts = [
        sum(int(t.wanted[t.classes == c].sum()) for t in truths)
        for c in range(len(CLASSES))
    ]
    print(
        f"{len(scans)} tested scans; boxes: {dict(zip(CLASSES, counts, strict=True))}",
        flush=True,
    )

    def test(network: nn.Module) -> list[float]:
        return precisions(
            detect(network, (view(scan.points, scan.reflectance) for scan in scans)),
            truths,
        )

    return test


def report(results: Mapping[str, Mapping[int, list[float]]]) -> str:
    """A Markdown table of the finished trainings: {arm: {seed: AP of every class}}."""
    names = [*CLASSES, "mean"]
    lines = [
        f"| half of each batch, besides the 30 scans | {' | '.join(names)} | mean - GT sampling | "
        "seeds |",
        "|---|" + "---:|" * (len(names) + 2),
    ]
    base = results.get(BASE, {})
    for name, found in results.items():
        table = 100 * np.array([[*ap, np.mean(ap)] for ap in found.values()])
        cells = [_spread(column) for column in table.T]
        paired = [
            100 * (np.mean(ap) - np.mean(base[seed]))
            for seed, ap in found.items()
            if seed in base and name != BASE
        ]
        cells += [_spread(paired, "+") if paired else "-", str(len(found))]
        lines.append(f"| {ARMS[name].title} | {' | '.join(cells)} |")
    lines += ["", "| | labels used besides those of the 30 scans |", "|---|---|"]
    lines += [f"| {ARMS[name].title} | {ARMS[name].budget} |" for name in results]
    return "\n".join(lines)


def _spread(values: Any, sign: str = "") -> str:
    """Mean ± standard deviation over seeds."""
    spread = f" ± {np.std(values, ddof=1):.1f}" if len(values) > 1 else ""
    return f"{np.mean(values):{sign}.1f}{spread}"


def finished(work: Work, arms: list[str], seeds: int) -> dict[str, dict[int, Any]]:
    """{arm: {seed: AP of every class}} of the trainings that have ended."""
    results: dict[str, dict[int, Any]] = {}
    for name in arms:
        for seed in range(seeds):
            path = work.result(name, seed)
            if path.exists():
                found = json.loads(path.read_text())["ap"]
                results.setdefault(name, {})[seed] = found
    return results


def train_arms(work: Work, arms: list[str], seeds: int, minutes: float) -> None:
    """Run the trainings that have not ended; none begins after so many minutes."""
    start = time.monotonic()
    test = cache(partial(make_test, work))
    for seed in range(seeds):
        for name in arms:
            path = work.result(name, seed)
            if path.exists() or time.monotonic() - start > 60 * minutes:
                continue
            found = run(work, name, seed, test())
            write_file(path, json.dumps(found).encode())
            shares = np.round(100 * np.array(found["ap"]), 1)
            print(f"{name}, seed {seed}: AP {shares}", flush=True)


def main(
    work: Path,
    arm: list[str] | None = None,
    seeds: int = 3,
    iterations: int = 1600,
    pool: int = 200,
    layout_model: str | None = None,
    minutes: float = float("inf"),
    out: Path | None = None,
) -> None:
    """Trains the arms, by default all; those with layout scans need a model."""
    torch.set_num_threads(1)
    folder = Work(work, iterations, pool, layout_model)
    possible = [n for n in ARMS if layout_model or ARMS[n].pool != "layout"]
    arms = arm or possible
    train_arms(folder, arms, seeds, minutes)
    text = (
        f"{report(finished(folder, arms, seeds))}\n\n{iterations} iterations of {BATCH}; "
        f"{machine()}; {time.strftime('%Y-%m-%d')}"
    )
    print(text)
    if out:
        out.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    typer.run(main)
