"""What generated scans first add with a few labelled frames; on a sensor with fewer beams, or with
another network. For docs/research/proof.md.

    python tools/research/few_labels.py SEMANTIC_KITTI OUT [--arm exchange] [--labelled 4] [--polar]

The places are split in two halves; frames of each half are trained on and the other half is
tested, so that two trainings of an arm test every place. Prints the mean gain and its interval,
and adds the scores by place to OUT/scores.json. ``--polar`` takes polar_network.py instead of the
range-view segmenter, ``--arm`` others of ``lidar-synth prove``. Call it with other ``--labelled``
for the curves in OUT/gain.png.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from polar_network import learn
from typer import run

from lidar_synth import ProofSettings, prove
from lidar_synth.lab.proof import Trainer, reference
from lidar_synth.lab.proof.arms import ARMS
from lidar_synth.lab.proof.scores import interval

ARM = ["recipe"]


def halves(root: Path, out: Path) -> list[tuple[Path, Path]]:
    """Folders with links to every second sequence and to the others, and the other way round."""
    folders = [out / "half-0", out / "half-1"]
    for number, sequence in enumerate(sorted((root / "sequences").iterdir())):
        link = folders[number % 2] / "sequences" / sequence.name
        link.parent.mkdir(parents=True, exist_ok=True)
        if not link.exists():
            link.symlink_to(sequence.resolve())
    one, other = folders
    return [(one, other), (other, one)]


def compare(
    trials: Sequence[Any],
    out: Path,
    group: str,
    settings: ProofSettings,
    pools: Path,
    trainer: Trainer = reference,
) -> dict[str, dict[str, float]]:
    """The mIoU by arm and place.

    Args:
        trials: pairs of scans to train on and scans to test.
        out: folder of all trials.
        group: names those with the same settings except for the number of labelled scans.
    """
    scores: dict[str, dict[str, float]] = {}
    for number, (training, tests) in enumerate(trials):
        folder = out / f"{group}-{settings.labelled}-{number}"
        proof = prove(
            training,
            folder,
            settings,
            jobs=1,
            trainer=trainer,
            pools=pools,
            tests=tests,
        )
        for row in proof.values["arms"]:
            scores.setdefault(row["key"], {}).update(row["miou_by_place"])
    return scores


def draw(records: Sequence[dict[str, Any]], base: dict[str, Any], path: Path) -> None:
    """The mean over the places by number of labelled frames, otherwise as in ``base``."""
    fixed = {key: value for key, value in base.items() if key != "labelled"}
    found: dict[str, dict[int, float]] = {}
    for record in records:
        if fixed.items() <= record.items():
            for arm, scores in record["arms"].items():
                mean = float(np.mean([*scores.values()]))
                found.setdefault(arm, {})[record["labelled"]] = mean
    figure, axes = plt.subplots(figsize=(7, 3.4), layout="constrained")
    plot(axes, found)
    figure.savefig(path)


def plot(axes: Any, found: dict[str, dict[int, float]]) -> None:
    """Curves of two arms over the labelled frames; a line for the training without a label."""
    for arm in ("recipe", "real"):
        means = dict(sorted(found.get(arm, {}).items()))
        axes.plot(means.keys(), means.values(), "o-", label=ARMS[arm].title)
    for mean in found.get("alone", {}).values():
        title = "generated scans alone, without a label"
        axes.axhline(mean, color="C2", linestyle="--", label=title)
    axes.set_xscale("log")
    axes.set_xticks([*found["real"]], found["real"])
    axes.minorticks_off()
    axes.set(xlabel="labelled frames", ylabel="mean IoU, %", ylim=(0, None))
    axes.legend(loc="lower right")


def main(
    root: Path,
    out: Path,
    arm: list[str] = ARM,
    beams: int | None = None,
    polar: bool = False,
    labelled: int = 4,
    iterations: int = 500,
    columns: int = 256,
    synthetic: int = 192,
    seeds: int = 2,
) -> None:
    """Trains and tests both ways."""
    setting: dict[str, Any] = {
        "beams": beams,
        "labelled": labelled,
        "iterations": iterations,
        "columns": columns,
        "synthetic": synthetic,
        "seeds": seeds,
    }
    settings = ProofSettings(arms=tuple(arm), **setting)
    setting["network"] = "polar" if polar else "range"
    pool = f"{beams or 'all'}-{columns}-{synthetic}"
    scores = compare(
        halves(root, out),
        out,
        f"{pool}-{setting['network']}-{iterations}",
        settings,
        out / f"pools-{pool}",
        learn if polar else reference,
    )
    for name, found in scores.items():
        gain = np.array([found[place] - scores["real"][place] for place in found])
        low, high = interval(gain[:, None]) or (np.nan, np.nan)
        mean = np.mean([*found.values()])
        print(f"{name}: {mean:.1f}, gain {gain.mean():+.1f} ({low:.1f} to {high:.1f})")
    path = out / "scores.json"
    kept = json.loads(path.read_text()) if path.is_file() else []
    records = [*kept, setting | {"arms": scores}]
    path.write_text(json.dumps(records, indent=1) + "\n")
    draw(records, setting, out / "gain.png")


if __name__ == "__main__":
    run(main)
