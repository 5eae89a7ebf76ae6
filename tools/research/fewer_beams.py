"""What generated scans first add with a few labelled frames, on a sensor with fewer beams or with
another network.

    python tools/research/fewer_beams.py SEMANTIC_KITTI OUT [--beams 16] [--polar] [--labelled 4]

The places are split in two halves; frames of each half are trained on and the other half is
tested, so that two trainings of an arm test every place. Prints the difference by place, its mean
and its interval. ``--polar`` takes polar_network.py instead of the range-view segmenter.
"""

import shutil
from pathlib import Path

import numpy as np
from polar_network import learn
from typer import run

from lidar_synth import ProofSettings, prove
from lidar_synth.lab.proof import reference
from lidar_synth.lab.proof.scores import interval


def halves(root: Path, out: Path) -> list[Path]:
    """Two folders with links to every second sequence."""
    folders = [out / "half-0", out / "half-1"]
    for number, sequence in enumerate(sorted((root / "sequences").iterdir())):
        link = folders[number % 2] / "sequences" / sequence.name
        link.parent.mkdir(parents=True, exist_ok=True)
        if not link.exists():
            link.symlink_to(sequence.resolve())
    return folders


def share(folder: Path, other: Path) -> None:
    """Copy the networks after the synthetic scans alone: they do not depend on the labelled ones."""
    if folder.is_dir():
        shutil.copytree(folder, other, dirs_exist_ok=True)


def main(
    root: Path,
    out: Path,
    beams: int | None = None,
    polar: bool = False,
    labelled: int = 4,
    iterations: int = 300,
    synthetic: int = 48,
    seeds: int = 1,
    columns: int = 256,
) -> None:
    """Trains and tests both ways."""
    settings = ProofSettings(
        labelled=labelled,
        arms=("pretrain-generator",),
        iterations=iterations,
        seeds=seeds,
        synthetic=synthetic,
        columns=columns,
        beams=beams,
    )
    folders = halves(root, out)
    group = f"{beams or 'all'}-{'polar' if polar else 'range'}-{iterations}"
    starts = out / f"starts-{group}"
    name = f"{group}-{labelled}"
    runs = [out / f"{name}-{number}" for number in range(2)]
    scores: dict[str, dict[str, float]] = {"real": {}, "pretrain-generator": {}}
    for number, (folder, other) in enumerate(
        zip(folders, reversed(folders), strict=True)
    ):
        share(starts, runs[number] / "starts")
        proof = prove(
            folder,
            runs[number],
            settings,
            jobs=1,
            trainer=learn if polar else reference,
            pools=out / f"pools-{beams or 'all'}",
            tests=other,
        )
        share(runs[number] / "starts", starts)
        for row in proof.values["arms"]:
            scores[row["key"]] |= row["miou_by_place"]
    places = sorted(scores["real"])
    real, first = (np.array([s[p] for p in places]) for s in scores.values())
    low, high = interval((first - real)[:, None]) or (np.nan, np.nan)
    gains = ", ".join(
        f"{p} {g:+.1f}" for p, g in zip(places, first - real, strict=True)
    )
    print(
        f"{name}: real {real.mean():.1f}, generated first {first.mean():.1f}, gain "
        f"{(first - real).mean():+.1f} ({low:.1f} to {high:.1f}); {gains}"
    )


if __name__ == "__main__":
    run(main)
