"""Why synthetic scans first help or harm, one change at a time. For docs/research/proof.md.

    python tools/research/why.py LABELLED OUT ARM... [--on pandaset] [--match]

LABELLED has semantic_kitti and PandaSet's frames (pandaset/sensor_frame/NN.npz). The places of
SemanticKITTI are split in two halves, the street of PandaSet in two ends: trained on one, tested
on the other, both ways. ARM is one of ``lidar-synth prove``, ``half`` (generated scans for half of
the training, then real ones alone) or ``pandar64`` (the town in that skin first). ``--match`` gives
the synthetic scans the quantiles of the labelled scans' reflectance.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from few_labels import halves
from other_sensor import read_frame
from typer import run

from lidar_synth import ProofSettings, prove
from lidar_synth.geometry.transfer import Response
from lidar_synth.lab.proof.arms import ARMS, Arm, ArmStage
from lidar_synth.lab.proof.pools import POOLS, town_scans
from lidar_synth.lab.proof.trial import Job, TrialOutcome, reference
from lidar_synth.lab.town import load_skin

POOLS["pandar64"] = lambda task: town_scans(task, load_skin("pandar64"))
ARMS["pandar64"] = Arm(
    "the town in the skin pandar64 first, then half",
    lambda ratio: (
        ArmStage(0.75, 1, "pandar64"),
        ArmStage(0.25, 0.5, "pandar64", rate=0.25),
    ),
)
ARMS["half"] = Arm(
    "generated scans for half, then real scans alone",
    lambda ratio: (ArmStage(0.5, 1, "generator"), ArmStage(0.5)),
)


def learn_matched(job: Job) -> dict[str, TrialOutcome]:
    """The reference training with the synthetic scans' reflectance as the labelled scans have it."""
    matched = {}
    for name, part in job.pools.items():
        response = Response.match(part, job.real)
        matched[name] = [
            replace(s, reflectance=response(s.reflectance).astype(np.float32))
            for s in part
        ]
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
) -> None:
    """Prints the arms' figures."""
    settings = ProofSettings(
        labelled=labelled,
        arms=tuple(arm),
        iterations=iterations,
        seeds=seeds,
        synthetic=48,
        columns=256,
    )
    trials: list[tuple[Any, Any]]
    if on == "pandaset":
        frames = sorted((labelled_scans / "pandaset" / "sensor_frame").glob("*.npz"))
        trials = [([read_frame(path) for path in frames], None)]
        settings = replace(settings, classes="pandaset", places="stretch:2")
    else:
        one, other = halves(labelled_scans / "semantic_kitti", out)
        trials = [(one, other), (other, one)]
    scores: dict[str, dict[str, float]] = {}
    for number, (training, tests) in enumerate(trials):
        proof = prove(
            training,
            out
            / f"{on}-{'match' if match else 'keep'}-{iterations}-{labelled}-{number}",
            settings,
            jobs=1,
            trainer=learn_matched if match else reference,
            pools=out / f"pools-{on}",
            tests=tests,
        )
        for row in proof.values["arms"]:
            scores.setdefault(row["key"], {}).update(row["miou_by_place"])
    for key, values in scores.items():
        places = ", ".join(f"{place} {value:.1f}" for place, value in values.items())
        print(f"{on}, {key}: {np.mean([*values.values()]):.1f} ({places})")


if __name__ == "__main__":
    run(main)
