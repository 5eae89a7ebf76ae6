"""Why the town first costs where the test is on the street of the labels: PandaSet's frames of one
street, four of one end trained on and the other end tested, both ways. For docs/research/proof.md.

    python tools/research/same_street.py LABELLED OUT ARM... [--reflectance drop] [--iterations 1000]

LABELLED has PandaSet's frames (pandaset/sensor_frame/NN.npz). ``--reflectance drop`` trains and
tests without reflectance; ``match`` gives the synthetic scans the quantiles of the labelled ones.
"""

from dataclasses import replace
from enum import StrEnum
from pathlib import Path

import numpy as np
from other_sensor import read_frame
from typer import run

from lidar_synth import ProofSettings, Scan, prove
from lidar_synth.geometry.transfer import Response
from lidar_synth.lab.proof.arms import ARMS, Arm, ArmStage
from lidar_synth.lab.proof.trial import Job, TrialOutcome, reference


def _first(pool: str, share: float, title: str, *later: ArmStage) -> Arm:
    return Arm(title, lambda ratio: (ArmStage(share, 1, pool), *later))


for _pool, _name in (("generator", "generated scans"), ("skin", "the town in a skin")):
    ARMS[f"half-{_pool}"] = _first(
        _pool, 0.5, f"{_name} for half, then real scans alone", ArmStage(0.5)
    )
    ARMS[f"quarter-{_pool}"] = _first(
        _pool, 0.25, f"{_name} for a quarter, then real scans alone", ArmStage(0.75)
    )


class Reflectance(StrEnum):
    """What is done with reflectance before a training."""

    keep = "keep"
    drop = "drop"
    match = "match"


def _dropped(scan: Scan) -> Scan:
    return replace(scan, reflectance=np.zeros(len(scan), np.float32))


def learn_without(job: Job) -> dict[str, TrialOutcome]:
    """The reference training on scans without reflectance."""
    return reference(
        replace(
            job,
            real=[_dropped(scan) for scan in job.real],
            held_out={
                n: [_dropped(s) for s in part] for n, part in job.held_out.items()
            },
            pools={n: [_dropped(s) for s in part] for n, part in job.pools.items()},
        )
    )


def learn_matched(job: Job) -> dict[str, TrialOutcome]:
    """The reference training with the synthetic scans' reflectance as the labelled scans have it."""
    pools = {}
    for name, part in job.pools.items():
        response = Response.match(part, job.real)
        pools[name] = [replace(s, reflectance=response(s.reflectance)) for s in part]
    return reference(replace(job, pools=pools))


TRAINERS = {"keep": reference, "drop": learn_without, "match": learn_matched}


def main(
    labelled: Path,
    out: Path,
    arm: list[str],
    reflectance: Reflectance = Reflectance.keep,
    iterations: int = 500,
    seeds: int = 1,
) -> None:
    """Prints the arms' figures."""
    frames = labelled / "pandaset" / "sensor_frame"
    scans = [read_frame(path) for path in sorted(frames.glob("*.npz"))]
    settings = ProofSettings(
        labelled=4,
        arms=tuple(arm),
        iterations=iterations,
        seeds=seeds,
        synthetic=48,
        columns=256,
        classes="pandaset",
        places="stretch:2",
    )
    proof = prove(
        scans,
        out / f"{reflectance}-{iterations}",
        settings,
        jobs=1,
        trainer=TRAINERS[reflectance],
        pools=out / "pools",
    )
    for row in proof.values["arms"]:
        print(
            iterations,
            reflectance,
            row["title"],
            row["miou_by_place"],
            row["difference"],
        )


if __name__ == "__main__":
    run(main)
