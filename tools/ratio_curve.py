"""Which ratio helps? mIoU of a segmenter over the share of synthetic scans in its training.

    python tools/ratio_curve.py [ROOT] [--model town-dense] [--labelled 40] [--epochs 20] [--seeds
    3] [--plot OUT.png]

Every epoch has a few labelled scans of the town (or of ROOT, SemanticKITTI for instance). Synthetic
scans are added up to 10, 25 and 50 % of the samples, so these runs have more iterations. "real, as
long" trains on the real scans alone for as many iterations as the longest of them. Every row is run
with several seeds of the weights, the order and the synthetic scans. Another town (or the split val
of ROOT) is held out. The table is that of docs/research/help-a-trainer.md.
"""

import argparse
from pathlib import Path

import matplotlib
import numpy as np
from tqdm import tqdm
from train_segmenter import fit, town

from lidar_synth import MixedScans, Scan, Source, load_generator, open_scans
from lidar_synth.files.disk import write_file
from lidar_synth.generate.generator import Generator
from lidar_synth.geometry.sensor import Sensor
from lidar_synth.geometry.transfer import Transfer
from lidar_synth.lab.evaluate.segmentation import class_ious, mean_iou
from lidar_synth.noise import keyed_rng

RATIOS = (0.0, 0.1, 0.25, 0.5)
BATCH = 4
LABELLED = 7
HELD_OUT = 1
"""Seeds of towns that no shipped generator was trained on; these learnt from labelled scans of the
town of seed 0."""


def run(
    real: Source, synthetic: list[Scan], ratio: float, steps: int, held_out: Source, seed: int
) -> np.ndarray:
    """The confusion matrix of one training."""
    # Every seed gets other synthetic scans.
    apart = np.random.default_rng(seed).permutation(len(synthetic))
    source = [synthetic[i] for i in apart] if ratio else None
    mixed = MixedScans(real, source, ratio, seed=seed, collate="range")
    _, table = fit(mixed, held_out, steps, BATCH, 0, seed)
    return table


def generated(generator: Generator, sensor: Sensor, count: int) -> list[Scan]:
    """Generated scans, turned into scans of the real ones' sensor."""
    change = None if generator.sensor.shape == sensor.shape else Transfer(sensor)
    scans = (generator.scans(0, [i])[0] for i in tqdm(range(count), desc="synthetic", unit="scan"))
    return [
        scan if change is None else change(scan, keyed_rng(0, i)) for i, scan in enumerate(scans)
    ]


def plot(path: Path, rows: dict[str, list[float]]) -> None:
    """Plot the means and standard deviations."""
    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(7, 4), layout="constrained")
    for place, (_, values) in enumerate(rows.items()):
        axes.errorbar(
            place, 100 * np.mean(values), 100 * np.std(values), fmt="o", capsize=4, color="tab:blue"
        )
        axes.plot([place] * len(values), 100 * np.asarray(values), ".", color="tab:gray", alpha=0.7)
    axes.set_xticks(range(len(rows)), rows)
    axes.set_ylabel("mIoU on held-out scans, %")
    axes.grid(axis="y", alpha=0.3)
    write_file(path, lambda file: figure.savefig(file, format="png", dpi=110))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("root", nargs="?", help="a labelled dataset [default: the town]")
    parser.add_argument("--model", default="town-dense")
    parser.add_argument("--labelled", type=int, default=40, help="real scans to train on")
    parser.add_argument("--held-out", type=int, default=200)
    parser.add_argument("--epochs", type=int, default=20, help="over the real scans")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--plot", type=Path)
    given = parser.parse_args()

    if given.root:
        source = open_scans(given.root, split="train")
        other = open_scans(given.root, split="val")
        real = [source[int(i)] for i in np.linspace(0, len(source) - 1, given.labelled)]
        held_out = [other[int(i)] for i in np.linspace(0, len(other) - 1, given.held_out)]
    else:
        # Twenty neighbouring scans share a stretch of road: a wide interval spreads few scans over
        # many stretches.
        real = town(LABELLED, 10 * given.labelled)[::10]
        held_out = town(HELD_OUT, given.held_out)
    synthetic = generated(load_generator(given.model), real[0].sensor, 10 * given.labelled)
    steps = {ratio: round(given.epochs * given.labelled / (1 - ratio) / BATCH) for ratio in RATIOS}
    settings = {f"{100 * ratio:.0f} %": (ratio, steps[ratio]) for ratio in RATIOS}
    settings["real, as long"] = (0.0, steps[RATIOS[-1]])
    rows: dict[str, list[float]] = {}
    print(
        f"{given.labelled} real scans, {given.epochs} epochs, batch {BATCH}, {len(held_out)} held "
        "out\n"
    )
    print(
        "| share synthetic | iterations | mIoU, % | seeds | car, person, pole, % "
        "|\n|---|---:|---:|---|---|"
    )
    for name, (ratio, count) in settings.items():
        tables = [run(real, synthetic, ratio, count, held_out, seed) for seed in range(given.seeds)]
        rows[name] = [mean_iou(table) for table in tables]
        mean = 100 * np.mean(rows[name])
        spread = 100 * np.std(rows[name])
        some = 100 * np.mean([class_ious(table)[[0, 5, 17]] for table in tables], 0)
        each = ", ".join(f"{100 * v:.1f}" for v in rows[name])
        print(
            f"| {name} | {count} | {mean:.1f} ± {spread:.1f} | {each} | "
            f"{', '.join(f'{v:.0f}' for v in some)} |",
            flush=True,
        )
    if given.plot:
        plot(given.plot, rows)


if __name__ == "__main__":
    main()
