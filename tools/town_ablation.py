"""What makes the town real to a network that learnt from real streets: one property put back at a
time.

    python tools/town_ablation.py SEMANTIC_KITTI --judge FOLDER [--streets 50] [--frames 1] [--skin
    FILE] [--only NAME]

SEMANTIC_KITTI is a folder of labelled real scans in that layout, FOLDER an archive of
lidar-bonnetal. The first table puts back one property of the sensor or of the surfaces that an
earlier town had; the second pastes the returns of one class, with occlusion, from real scans into
scans of the town and from the town into real scans, and gives the share of the pasted cells that
the network recognises. docs/research/judge.md has the tables.
"""

import argparse
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from lidar_synth.datasets.classes import TRAIN_ID
from lidar_synth.formats import open_scans
from lidar_synth.geometry.scan import Scan
from lidar_synth.geometry.sensor import load_sensor
from lidar_synth.lab.evaluate.distances import frechet_distance
from lidar_synth.lab.evaluate.recognition import Recognition
from lidar_synth.lab.evaluate.street_judge import StreetJudge, load_archive
from lidar_synth.lab.town import STRETCH_FRAMES, Town, returns
from lidar_synth.lab.town.materials import INDEX
from lidar_synth.lab.town.returns import Noise

SHOWN = (
    "car",
    "road",
    "sidewalk",
    "parking",
    "building",
    "fence",
    "vegetation",
    "terrain",
    "trunk",
    "pole",
)
SOFT = ("leaf", "foliage", "grass", "soil", "gravel")

Image = tuple[Tensor, NDArray[np.uint8]]
"""The network's input (5, H, W) and the labels (H, W)."""


class Change(NamedTuple):
    """What is put back.

    Args:
        tables: {name of a table of ``town.returns``: {material: value in place of its own}}; ""
            stands for all.
        factors: {name of a table: factor of all materials}.
        constants: {name of a constant of ``town.returns``: value}.
        town: options of ``Town``.
        columns: firings per turn, one through the centre of each cell; None for the sensor's own.
    """

    tables: Mapping[str, Mapping[str, float]] = MappingProxyType({})
    factors: Mapping[str, float] = MappingProxyType({})
    constants: Mapping[str, float] = MappingProxyType({})
    town: Mapping[str, Any] = MappingProxyType({})
    columns: int | None = None


CHANGES = {
    "the town": Change(),
    "1,024 firings, not 2,175": Change(columns=1024),
    "the vehicle stands still": Change(town={"motion": False}),
    "range noise 1.8 cm, not 0.8": Change(town={"noise": Noise(range_std=0.018)}),
    "speckle x 2": Change(factors={"_SPECKLE": 2.0}),
    "speckle x 0.5": Change(factors={"_SPECKLE": 0.5}),
    "no knee in the response": Change(constants={"_SLOPE": 1.0}),
    "no relief": Change(factors={"_RELIEF": 0.0}),
    "no relief, no roughness": Change(factors={"_RELIEF": 0.0, "_ROUGHNESS": 0.0}),
    "leaves let 10 % through, not 35": Change(tables={"_TRANSMISSION": {"leaf": 0.1}}),
    "soft surfaces darken at grazing angles": Change(tables={"_GRAZING": dict.fromkeys(SOFT, 0.0)}),
}
"""The lines of the first table."""

PASTED = ("vegetation", "terrain", "building", "car", "road")


@contextmanager
def applied(change: Change) -> Iterator[None]:
    """The town's sensor model with a change; it is restored afterwards."""
    names = {*change.tables, *change.factors, *change.constants}
    before = {name: getattr(returns, name) for name in names}
    for name, factor in change.factors.items():
        setattr(returns, name, getattr(returns, name) * np.float32(factor))
    for name, values in change.tables.items():
        table = getattr(returns, name).copy()
        table[[INDEX[material] for material in values]] = list(values.values())
        setattr(returns, name, table)
    for name, value in change.constants.items():
        setattr(returns, name, value)
    try:
        yield
    finally:
        for name, value in before.items():
            setattr(returns, name, value)


def town_scans(change: Change, streets: int, frames: int, seed: int) -> Iterator[Scan]:
    """Evenly spaced scans of each of the first streets of a town."""
    sensor = load_sensor("town")
    if change.columns is not None:
        sensor = replace(sensor, columns=change.columns, firings=None, azimuths=None)
    town = Town(seed, sensor, streets * STRETCH_FRAMES, **change.town)
    for street in tqdm(range(streets), leave=False):
        for frame in range(frames):
            yield town[street * STRETCH_FRAMES + (2 * frame + 1) * STRETCH_FRAMES // (2 * frames)]


def row(name: str, scans: list[Scan], judge: StreetJudge, real: NDArray[np.floating]) -> str:
    """A line of the first table: points of a scan, distance of the judge's features from real ones,
    recognition."""
    found = Recognition(judge.confusion(scans), judge.features(scans))
    ious = found.iou()
    cells = [
        f"{np.mean([len(scan) for scan in scans]):,.0f}",
        f"{frechet_distance(found.features, real):.2f}",
    ]
    cells += [f"{100 * found.accuracy:.1f}", f"{100 * found.mean_iou:.1f}"]
    cells += [f"{100 * ious[c]:.0f}" if c in ious else "" for c in SHOWN]
    return f"| {name} | {' | '.join(cells)} |"


def paste(
    into: Image, source: Image, name: str, judge: StreetJudge
) -> tuple[Image, NDArray[np.bool_]]:
    """The returns of one class from ``source`` where they are nearer than those of ``into``, and
    these cells (H, W)."""
    (x, label), (other, labels) = into, source
    distance = [
        image[0] * judge.segmenter.deviation[0] + judge.segmenter.mean[0] for image in (x, other)
    ]
    empty = (x == 0).all(0)
    taken = torch.from_numpy(labels == TRAIN_ID[name]) & (empty | (distance[1] < distance[0]))
    mask = taken.numpy()
    return (torch.where(taken, other, x), np.where(mask, labels, label)), mask


def recognised(
    judge: StreetJudge, pairs: list[tuple[Image, NDArray[np.bool_]]], name: str
) -> float:
    """Share of the given cells that the network takes for a class."""
    hits = total = 0
    for (image, _), cells in pairs:
        predicted = judge.predict(image)
        hits = hits + int((predicted[cells] == TRAIN_ID[name]).sum())
        total = total + int(cells.sum())
    return hits / max(1, total)


def exchange(judge: StreetJudge, real: list[Image], town: list[Image]) -> Iterator[str]:
    """The lines of the second table."""
    for name in PASTED:
        shares = []
        for into, source in ((real, real), (town, real), (town, town), (real, town)):
            # Within one set, the class of another scan is pasted, so that all four figures are of
            # pasted returns.
            pairs = [
                paste(into[i % len(into)], source[(i + 5) % len(source)], name, judge)
                for i in range(len(town))
            ]
            shares.append(recognised(judge, pairs, name))
        yield f"| {name} | {' | '.join(f'{100 * share:.0f}' for share in shares)} |"


def main() -> None:
    """Prints both tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("root", type=Path, help="labelled real scans in SemanticKITTI's layout")
    parser.add_argument("--judge", type=Path, required=True, help="archive of lidar-bonnetal")
    parser.add_argument("--streets", type=int, default=50)
    parser.add_argument("--frames", type=int, default=1, help="of each street")
    parser.add_argument("--skin", help="of the town in all lines: a shipped one by name, or a file")
    parser.add_argument("--width", type=int, default=1024, help="of the judge's grid")
    parser.add_argument("--seed", type=int, default=7, help="of the town")
    parser.add_argument(
        "--only", nargs="*", choices=list(CHANGES), default=list(CHANGES), metavar="NAME"
    )
    given = parser.parse_args()

    judge = load_archive(given.judge, given.width)
    source = open_scans(given.root)
    real = [source[i] for i in range(len(source))]
    features = judge.features(real)
    print(
        f"| 64 x {given.width}, % | points | Frechet | accuracy | mIoU | "
        + " | ".join(SHOWN)
        + " |"
    )
    print("|---|" + "---:|" * (len(SHOWN) + 4))
    print(row("real scans", real, judge, features), flush=True)
    for name in given.only:
        change = CHANGES[name]._replace(town={**CHANGES[name].town, "skin": given.skin})
        with applied(change):
            scans = list(town_scans(change, given.streets, given.frames, given.seed))
        print(row(name, scans, judge, features), flush=True)
    if given.only != list(CHANGES):
        return
    print(
        "\n| recognised, % | real in real | real in town | town in town | town in real "
        "|\n|---|---:|---:|---:|---:|"
    )
    town = [judge.image(scan) for scan in town_scans(Change(), given.streets, 1, given.seed)]
    for line in exchange(judge, [judge.image(scan) for scan in real], town):
        print(line, flush=True)


if __name__ == "__main__":
    main()
