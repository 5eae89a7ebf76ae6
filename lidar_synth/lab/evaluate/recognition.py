"""How well a network recognises the classes of scans: accuracy, IoU and the most frequent
confusions, as a table."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import NAMES
from lidar_synth.errors import DataError
from lidar_synth.geometry import Source
from lidar_synth.lab.evaluate.distances import frechet_distance, squared_mmd
from lidar_synth.lab.evaluate.isolated import count_isolated, share_of_isolated
from lidar_synth.lab.evaluate.reading import readable
from lidar_synth.lab.evaluate.segmentation import class_ious, mean_iou
from lidar_synth.lab.evaluate.street_judge import StreetJudge


@dataclass(frozen=True)
class Recognition:
    """The labels of a set of scans beside the predictions of a network.

    Args:
        table: (19, 19) number of cells by label (row) and prediction (column).
        features: (n, D) features of the n scans.
        isolated_counts: (2, 20) as ``count_isolated``, of all scans.
    """

    table: NDArray[np.int64]
    features: NDArray[np.floating]
    isolated_counts: NDArray[np.int64]

    @property
    def accuracy(self) -> float:
        """Share of labelled cells that are predicted correctly, in [0, 1]."""
        return float(np.trace(self.table) / self.table.sum())

    @property
    def mean_iou(self) -> float:
        """Mean IoU over the classes that occur in the labels, in [0, 1]."""
        return mean_iou(self.table)

    def iou(self) -> dict[str, float]:
        """IoU in [0, 1] of the classes that occur in the labels."""
        ious = class_ious(self.table)
        return {
            name: float(ious[i]) for i, name in enumerate(NAMES) if self.table[i].sum()
        }

    def isolated(self) -> dict[str, float]:
        """Share of isolated returns, in [0, 1], of the classes that occur in the
        labels."""
        shares = share_of_isolated(self.isolated_counts)
        counts = self.isolated_counts[1]
        return {name: float(shares[i]) for i, name in enumerate(NAMES) if counts[i]}

    def confusions(self, name: str) -> list[tuple[str, float]]:
        """The two classes most often predicted instead of a class, with their share of its cells
        from 5 % on, largest first."""
        row = self.table[NAMES.index(name)] / max(
            1, self.table[NAMES.index(name)].sum()
        )
        order = [i for i in np.argsort(-row) if NAMES[i] != name and row[i] >= 0.05]
        return [(NAMES[i], float(row[i])) for i in order[:2]]


def recognise(
    judge: StreetJudge, scans: Source, name: str = "scans", progress: bool = True
) -> Recognition:
    """Let a network predict the classes of labelled scans.

    Args:
        judge: the network.
        scans: labelled scans.
        name: what the progress bar calls them.
        progress: whether to show a progress bar.

    Raises:
        DataError: on scans without labels, or without one labelled return.
    """
    table = np.zeros((len(NAMES), len(NAMES)), np.int64)
    isolated = np.zeros((2, len(NAMES) + 1), np.int64)
    features = []
    for scan in readable(scans, None, name, progress):
        table += judge.confusion([scan])
        features.append(judge.features([scan]))
        isolated += count_isolated(scan)
    if not table.sum():
        raise DataError(
            f"{name}: no labelled return", "at least one label that is not 255 = ignore"
        )
    return Recognition(table, np.concatenate(features), isolated)


def compare(real: Recognition, fake: Recognition) -> dict[str, Any]:
    """The figures of two sets as plain values; feature distances need at least two scans in each
    set."""
    figures: dict[str, Any] = {
        name: {
            "scans": len(r.features),
            "accuracy": r.accuracy,
            "mean_iou": r.mean_iou,
            "iou": r.iou(),
            "isolated": r.isolated(),
            "confusions": {k: dict(r.confusions(k)) for k in r.iou()},
        }
        for name, r in (("real", real), ("fake", fake))
    }
    if min(len(real.features), len(fake.features)) > 1:
        figures["frechet_distance"] = frechet_distance(real.features, fake.features)
        figures["squared_mmd"] = squared_mmd(real.features, fake.features)
    return figures


def as_text(figures: Mapping[str, Any]) -> str:
    """The figures of ``compare`` as a table in Markdown."""
    real = figures["real"]
    fake = figures["fake"]
    lines = [
        f"| % | real ({real['scans']} scans) | fake ({fake['scans']} scans) | fake, predicted "
        "instead | isolated returns, real | fake |",
        "|---|---:|---:|---|---:|---:|",
        f"| accuracy | {100 * real['accuracy']:.1f} | {100 * fake['accuracy']:.1f} | | | |",
        f"| mean IoU | {100 * real['mean_iou']:.1f} | {100 * fake['mean_iou']:.1f} | | | |",
    ]
    for name in (n for n in NAMES if n in real["iou"] or n in fake["iou"]):
        instead = ", ".join(
            f"{k} {100 * v:.0f}" for k, v in fake["confusions"].get(name, {}).items()
        )
        ious = _shown(real["iou"], fake["iou"], name)
        isolated = _shown(real["isolated"], fake["isolated"], name)
        lines.append(f"| {name} | {ious} | {instead} | {isolated} |")
    for key, label in (
        ("frechet_distance", "Frechet distance"),
        ("squared_mmd", "squared MMD"),
    ):
        if key in figures:
            lines.append(f"| {label} of features | | {figures[key]:.4g} | | | |")
    return "\n".join(lines)


def _shown(real: Mapping[str, float], fake: Mapping[str, float], name: str) -> str:
    """The values of a class in both sets, per cent, as two cells of a table."""
    cells = [f"{100 * side[name]:.1f}" if name in side else "" for side in (real, fake)]
    return " | ".join(cells)
