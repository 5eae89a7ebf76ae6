"""What generated scans first add where the labels are of another sensor: trained on Pandar64
scans that are turned into an HDL-64E's, tested on SemanticKITTI. For docs/research/proof.md.

    python tools/research/other_sensor.py LABELLED OUT [--match] [--seeds N]

LABELLED has PandaSet's frames (pandaset/sensor_frame/NN.npz) and semantic_kitti. --match gives
them the distribution of reflectance of seven SemanticKITTI scans, without their labels.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
from typer import run

from lidar_synth import ProofSettings, Scan, SemanticKITTI, load_sensor, prove
from lidar_synth.datasets.classes import PANDASET
from lidar_synth.geometry.transfer import Measurement, Response, Transfer


def read_frame(path: Path) -> Scan:
    """A labelled frame of the Pandar64."""
    with np.load(path) as file:
        return Scan(
            file["points"],
            file["reflectance"].astype(np.float32) / 255,
            load_sensor("pandar64"),
            label=PANDASET.decode(file["label"]),
            id=f"002/{path.stem}",
        )


def main(labelled: Path, out: Path, match: bool = False, seeds: int = 1) -> None:
    """Prints both trainings' figures."""
    tests = SemanticKITTI(labelled / "semantic_kitti")
    frames = labelled / "pandaset" / "sensor_frame"
    scans = [read_frame(path) for path in sorted(frames.glob("*.npz"))]
    response = Response.match(scans[::4], [tests[i] for i in range(0, 28, 4)])
    measured = Measurement(response=response if match else None)
    turn = Transfer(tests.sensor, measurement=measured)
    settings = ProofSettings(
        labelled=24,
        arms=("pretrain-generator",),
        iterations=300,
        seeds=seeds,
        synthetic=48,
        columns=256,
        classes="pandaset",
    )
    turned = [replace(turn(scan), id=scan.id) for scan in scans]
    for row in prove(turned, out, settings, jobs=1, tests=tests).values["arms"]:
        print(row["title"], row["miou"], row["difference"], row["interval"])


if __name__ == "__main__":
    run(main)
