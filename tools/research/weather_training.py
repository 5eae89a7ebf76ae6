"""Does a network learn to withstand weather and failing sensors from the corruptions? For
docs/research/weather.md.

    python tools/research/weather_training.py LABELLED [--iterations N] [--seeds N] [--folds N]
        [--chance P] [--first SEED]

LABELLED is a root of SemanticKITTI; a sequence is a place. The small segmenter of ``prove`` is
trained on the other places, with and without the benchmark's corruptions among its augmentations,
with the same scans, order and iterations, and tested on the places left out.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from typer import run

from lidar_synth import Compose, MixedScans, Scan, SemanticKITTI
from lidar_synth.lab.evaluate.robustness import NAMES_OF_BENCHMARK, Card, stress
from lidar_synth.lab.evaluate.segmentation import Judge
from lidar_synth.lab.evaluate.segmenter import RangeSegmenter
from lidar_synth.lab.proof.trial import turn_scan
from lidar_synth.lab.train.segmentation import endless_batches, train_segmenter
from lidar_synth.weather import SEVERITIES

FOLDS = 3
CHANCE = 0.15
"""Probability of each corruption: nearly three scans in four have one or more; --chance."""
BATCH = 2
WIDTHS = (8, 16, 32, 48)
"""Channels of the segmenter: half of its default."""


def steps_of(chance: float) -> list[Any]:
    """The benchmark's corruptions as steps of ``Compose``, each with a probability."""
    return [
        {name: {"severity": list(SEVERITIES), "p": chance}}
        for name in NAMES_OF_BENCHMARK
    ]


def train(scans: Sequence[Scan], steps: list[Any], iterations: int, seed: int) -> Judge:
    """The segmenter, trained on some scans."""
    torch.manual_seed(seed)
    mixed = MixedScans(
        scans,
        ratio=0,
        seed=seed,
        epoch_size=iterations * BATCH,
        augment=Compose([*steps, turn_scan]),
        augment_real=True,
        collate="range",
    )
    sensor = scans[0].sensor
    network = RangeSegmenter(widths=WIDTHS)
    height = torch.from_numpy(np.sin(sensor.ray_angles()[0]))
    batches = endless_batches(mixed, BATCH)
    train_segmenter(network, batches, height, iterations, progress=False)
    return Judge(network, sensor, {})


def main(
    labelled: Path,
    iterations: int = 600,
    seeds: int = 2,
    folds: int = FOLDS,
    chance: float = CHANCE,
    first: int = 0,
) -> None:
    """Prints the card of each training, and the means of both arms."""
    source = SemanticKITTI(labelled)
    scans = [source[i] for i in range(len(source))]
    places = sorted({scan.id.split("/")[0] for scan in scans})
    arms = {"without": [], "with": steps_of(chance)}
    cards: dict[str, list[Card]] = {arm: [] for arm in arms}
    for seed in range(first, first + seeds):
        for fold in range(folds):
            held = places[fold::FOLDS]
            test = [scan for scan in scans if scan.id.split("/")[0] in held]
            known = [scan for scan in scans if scan.id.split("/")[0] not in held]
            for arm, steps in arms.items():
                judge = train(known, steps, iterations, seed)
                card = stress(
                    test, lambda s, _, j=judge: j.agreement(s), progress=False
                )
                cards[arm].append(card)
                print(
                    f"{arm}, seed {seed}, without {held}\n\n{card.to_text()}\n",
                    flush=True,
                )
    print(
        "| arm | clean mIoU % | mean error under the corruptions % |\n|---|---:|---:|"
    )
    for arm, made in cards.items():
        clean = np.mean([card.clean for card in made])
        error = np.mean([1 - np.mean(list(card.means.values())) for card in made])
        print(f"| {arm} | {100 * clean:.1f} | {100 * error:.1f} |")


if __name__ == "__main__":
    run(main)
