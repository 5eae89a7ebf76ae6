"""Does a network learn to withstand weather and failing sensors from the corruptions? For
docs/research/weather.md.

    python tools/research/weather_training.py LABELLED | town [--iterations N] [--seeds N]
        [--folds N] [--chance P] [--first SEED] [--columns N] [--width N]

LABELLED is a root of SemanticKITTI; a sequence is a place. The small segmenter of ``prove`` is
trained on the other places, with and without the benchmark's corruptions among its augmentations,
with the same scans, order and iterations, and tested on the places left out. ``town`` trains in one
town and tests in another, one pair for each fold and seed, with so many columns.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from typer import run

from lidar_synth import Compose, MixedScans, Scan, SemanticKITTI, Town, load_sensor
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
WIDTH = 8
"""Channels of the segmenter's first level, half of its default; --width."""
TOWN_SCANS = 300
TOWN_TEST = 60
FIRST_TOWN = 1000
SPACING = 10
"""Every how many scans of a town one is taken: 4 s apart."""


class Fold(NamedTuple):
    """Scans to train on and scans of other places to test on."""

    tested: str
    known: list[Scan]
    test: list[Scan]


def steps_of(chance: float) -> list[Any]:
    """The benchmark's corruptions as steps of ``Compose``, each with a probability."""
    return [
        {name: {"severity": list(SEVERITIES), "p": chance}}
        for name in NAMES_OF_BENCHMARK
    ]


def train(
    scans: Sequence[Scan], steps: list[Any], iterations: int, seed: int, width: int
) -> Judge:
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
    network = RangeSegmenter(widths=(width, 2 * width, 4 * width, 6 * width))
    height = torch.from_numpy(np.sin(sensor.ray_angles()[0]))
    batches = endless_batches(mixed, BATCH)
    train_segmenter(network, batches, height, iterations, progress=False)
    return Judge(network, sensor, {})


def split_places(root: str, folds: int) -> Iterator[Fold]:
    """The places of a SemanticKITTI folder, some left out in each fold."""
    scans = list(SemanticKITTI(root))
    places = sorted({scan.id.split("/")[0] for scan in scans})
    for fold in range(folds):
        held = places[fold::FOLDS]
        test = [scan for scan in scans if scan.id.split("/")[0] in held]
        known = [scan for scan in scans if scan.id.split("/")[0] not in held]
        yield Fold(", ".join(held), known, test)


def cast(seed: int, count: int, columns: int) -> list[Scan]:
    """Scans of a town, spaced out."""
    sensor = replace(load_sensor("hdl64e_lasers"), columns=columns, firings=None)
    town = Town(seed, sensor, count * SPACING)
    return [town[i * SPACING] for i in range(count)]


def cast_towns(seed: int, folds: int, columns: int) -> Iterator[Fold]:
    """Pairs of towns that nothing else uses."""
    for fold in range(folds):
        first = FIRST_TOWN + 2 * (seed * FOLDS + fold)
        known, test = (
            cast(town, count, columns)
            for town, count in ((first, TOWN_SCANS), (first + 1, TOWN_TEST))
        )
        yield Fold(f"town {first + 1}", known, test)


def main(
    labelled: str,
    iterations: int = 600,
    seeds: int = 2,
    folds: int = FOLDS,
    chance: float = CHANCE,
    first: int = 0,
    columns: int = 512,
    width: int = WIDTH,
) -> None:
    """Prints the card of each training, and the means of both arms."""
    arms = {"without": [], "with": steps_of(chance)}
    cards: dict[str, list[Card]] = {arm: [] for arm in arms}
    for seed in range(first, first + seeds):
        places = (
            cast_towns(seed, folds, columns)
            if labelled == "town"
            else split_places(labelled, folds)
        )
        for fold in places:
            for arm, steps in arms.items():
                judge = train(fold.known, steps, iterations, seed, width)
                card = stress(
                    fold.test, lambda s, _, j=judge: j.agreement(s), progress=False
                )
                cards[arm].append(card)
                print(
                    f"{arm}, seed {seed}, tested on {fold.tested}\n\n{card.to_text()}\n",
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
