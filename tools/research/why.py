"""Why synthetic scans first help or harm, one change at a time. For docs/research/proof.md.

    python tools/research/why.py LABELLED OUT ARM... [--on pandaset] [--match] [--model town]

LABELLED has semantic_kitti and PandaSet's frames (pandaset/sensor_frame/NN.npz). The places of
SemanticKITTI are split in two halves, the street of PandaSet in two ends: trained on one, tested
on the other, both ways. ARM is one of ``lidar-synth prove``, ``half`` (generated scans for half of
the training, then real ones alone), or the name of a pool below: the town first, in the skin
``pandar64``, ``standing`` (each scan taken at one moment), ``streets`` (standing, one scan a
street), ``kept`` or ``recast`` (standing, by the generator's sensor, then turned into scans of the
user's: its returns, or rays cast at its surfaces). ``--match`` gives the synthetic scans the
quantiles of the labelled scans' reflectance, as ``prove`` does where the generator's lasers are
others.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from few_labels import compare, halves
from other_sensor import read_frame
from typer import run

from lidar_synth import ProofSettings, Scan, load_generator
from lidar_synth.geometry.transfer import Transfer
from lidar_synth.lab.proof.arms import ARMS, EPOCHS, FIRST, Arm
from lidar_synth.lab.proof.pools import (
    FRAMES,
    POOLS,
    PoolTask,
    match_reflectance,
    town_scans,
)
from lidar_synth.lab.proof.trial import Job, TrialOutcome, reference
from lidar_synth.lab.town import STRETCH_FRAMES, Town, load_skin
from lidar_synth.noise import keyed_rng


def standing_town(task: PoolTask, frames: tuple[int, ...] = FRAMES) -> Iterator[Scan]:
    """Scans of these frames of each street of the town, each taken at one moment."""
    streets = -(-task.count // len(frames))
    size = streets * STRETCH_FRAMES
    town = Town(task.town_seed, task.sensor, size, motion=False)
    for street in range(streets):
        for frame in frames:
            yield town[STRETCH_FRAMES * street + frame]


def turned_town(task: PoolTask, recast: bool) -> Iterator[Scan]:
    """The standing town by the sensor of the generator, turned into scans of the user's."""
    change = Transfer(task.sensor, recast=recast)
    other = replace(task, sensor=load_generator(task.model).sensor)
    for index, scan in enumerate(standing_town(other)):
        yield change(scan, keyed_rng(0, index))


TOWNS: dict[str, Callable[[PoolTask], Iterator[Scan]]] = {
    "pandar64": lambda task: town_scans(task, load_skin("pandar64")),
    "standing": standing_town,
    "streets": lambda task: standing_town(task, FRAMES[:1]),
    "kept": lambda task: turned_town(task, False),
    "recast": lambda task: turned_town(task, True),
}
for name, make in TOWNS.items():
    POOLS[name] = make
    ARMS[name] = Arm(f"the town ({name}) first, then half", name, FIRST)
ARMS["half"] = Arm(
    "generated scans for half, then real scans alone",
    "generator",
    {0: 1.0, EPOCHS // 2: 0.0},
)


def learn_matched(job: Job) -> dict[str, TrialOutcome]:
    """The reference training; synthetic scans get the reflectance of the labelled scans."""
    matched = {n: match_reflectance(part, job.real) for n, part in job.pools.items()}
    return reference(replace(job, pools=matched))


def main(
    labelled_scans: Path,
    out: Path,
    arm: list[str],
    on: str = "semantic_kitti",
    match: bool = False,
    labelled: int = 4,
    iterations: int = 500,
    seeds: int = 1,
    synthetic: int = 48,
    model: str = "town",
) -> None:
    """Prints the arms' figures."""
    settings = ProofSettings(
        labelled=labelled,
        arms=tuple(arm),
        iterations=iterations,
        seeds=seeds,
        synthetic=synthetic,
        columns=256,
        model=model,
    )
    if on == "pandaset":
        frames = sorted((labelled_scans / "pandaset" / "sensor_frame").glob("*.npz"))
        trials: Any = [([read_frame(path) for path in frames], None)]
        settings = replace(settings, classes="pandaset", places="stretch:2")
    else:
        trials = halves(labelled_scans / "semantic_kitti", out)
    scores = compare(
        trials,
        out,
        f"{on}-{'match' if match else 'keep'}-{synthetic}-{iterations}",
        settings,
        out / f"pools-{on}-{synthetic}",
        learn_matched if match else reference,
    )
    for key, values in scores.items():
        places = ", ".join(f"{place} {value:.1f}" for place, value in values.items())
        print(f"{on}, {key}: {np.mean([*values.values()]):.1f} ({places})")


if __name__ == "__main__":
    run(main)
