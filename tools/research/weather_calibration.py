"""How much of its clean score a network keeps under each corruption: docs/research/weather.md.

    python tools/research/weather_calibration.py JUDGE LABELLED [--every N]

JUDGE is a folder of lidar-bonnetal's archive, LABELLED a root of SemanticKITTI. The
published shares are those of SqueezeSeg in the Robo3D benchmark.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from tqdm import tqdm
from typer import run

from lidar_synth import SemanticKITTI
from lidar_synth.geometry.scan import Scan
from lidar_synth.lab.evaluate.segmentation import mean_iou
from lidar_synth.lab.evaluate.street_judge import StreetJudge, load_archive
from lidar_synth.weather import CORRUPTIONS, SEVERITIES

PUBLISHED = {
    "fog": 59.6,
    "wet_ground": 86.4,
    "snow": 71.8,
    "motion_blur": 56.7,
    "missing_beams": 79.1,
    "crosstalk": 68.5,
    "incomplete_echo": 87.5,
    "cross_sensor": 24.8,
}
"""Share of the clean mIoU that is left, %, mean of the severities."""


def score(judge: StreetJudge, scans: Sequence[Scan]) -> float:
    """mIoU of the classes that occur in the scans, %."""
    return 100 * mean_iou(judge.confusion(scans))


def main(judge: Path, labelled: Path, every: int = 1) -> None:
    """Prints the table of every Nth scan."""
    archive = load_archive(judge, 2048)
    source = SemanticKITTI(labelled)
    scans = [source[i] for i in range(0, len(source), every)]
    clean = score(archive, scans)
    print(f"{len(scans)} scans, clean mIoU {clean:.1f} %\n")
    print(
        f"| % of it | published | mean | {' | '.join(SEVERITIES)} |\n|---|{'---:|' * 5}"
    )
    for name, kind in tqdm(CORRUPTIONS.items()):
        shares = []
        for severity in SEVERITIES:
            change = kind.at(severity)
            rngs = map(np.random.default_rng, range(len(scans)))
            changed = [change(s, r) for s, r in zip(scans, rngs, strict=True)]
            shares.append(100 * score(archive, changed) / clean)
        cells = [PUBLISHED.get(name, ""), f"{np.mean(shares):.1f}"]
        cells += [f"{share:.0f}" for share in shares]
        tqdm.write(f"| {name} | {' | '.join(map(str, cells))} |")


if __name__ == "__main__":
    run(main)
