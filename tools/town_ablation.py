"""Why a network that learnt from real streets rejects the town: one change at a time, each a line of a table.

    python tools/town_ablation.py SEMANTIC_KITTI --judge FOLDER [--streets 50] [--only NAME ...]

SEMANTIC_KITTI is a folder of labelled real scans in that layout, FOLDER an archive of lidar-bonnetal. The first table
changes one property of the town's surfaces, sensor or points; the second pastes the returns of one class, with
occlusion, from real scans into scans of the town and from the town into real scans, and gives the share of the pasted
cells that the network recognises. docs/research/judge.md has the tables.
"""

import argparse
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from lidar_synth.datasets.classes import TRAIN_ID
from lidar_synth.evaluate.recognition import Recognition
from lidar_synth.evaluate.street_judge import StreetJudge, load_archive
from lidar_synth.formats import open_scans
from lidar_synth.geometry.scan import Scan
from lidar_synth.geometry.sensor import load_sensor
from lidar_synth.town import STRETCH_FRAMES, Town, ground, returns
from lidar_synth.town.materials import INDEX
from lidar_synth.town.returns import Noise

SHOWN = ("car", "road", "sidewalk", "parking", "building", "fence", "vegetation", "terrain", "trunk", "pole")
LEAVES, SOIL = ("leaf", "foliage"), ("grass", "soil")

Image = tuple[Tensor, NDArray[np.uint8]]
"""The network's input (5, H, W) and the labels (H, W)."""


NONE: Mapping[str, float] = MappingProxyType({})


class Change(NamedTuple):
    """A change of the town.

    Args:
        speckle: factor of the reflectance's standard deviation between returns.
        kept: factor of it for leaves, grass and soil, if it is another one.
        range_std: metres, standard deviation of the range.
        roughness, transmission: by material, in place of its own.
        lift: metres above the carriageway, by kind of ground, in place of its own.
        columns: firings per turn.
        edit: changes each scan.
    """

    speckle: float = 1.0
    kept: float | None = None
    range_std: float = 0.018
    roughness: Mapping[str, float] = NONE
    transmission: Mapping[str, float] = NONE
    lift: Mapping[str, float] = NONE
    columns: int = 1024
    edit: Callable[[Scan], Scan] = lambda scan: scan


def _lower(scan: Scan) -> Scan:
    return replace(scan, points=scan.points - np.array([0, 0, 0.045], np.float32))


_SMOOTH = {"speckle": 0.5, "kept": 0.65, "range_std": 0.006}
CHANGES = {
    "the town": Change(),
    "range noise 0.6 cm, not 1.8": Change(range_std=0.006),
    "speckle x 0.5": Change(speckle=0.5),
    "speckle x 0.5, of leaves, grass and soil x 0.65": Change(speckle=0.5, kept=0.65),
    "speckle x 0.2": Change(speckle=0.2),
    "sensor 4.5 cm lower": Change(edit=_lower),
    "2048 firings": Change(columns=2048),
    "leaves rough by 20 cm, not 3": Change(roughness=dict.fromkeys(LEAVES, 0.2)),
    "leaves let 60 % through, not 10": Change(transmission={"leaf": 0.6}),
    "grass and soil rough by 5 cm, not 2.5": Change(roughness=dict.fromkeys(SOIL, 0.05)),
    "grass and soil 13 cm lower": Change(lift=dict.fromkeys(SOIL, -0.03)),
    "smooth: range noise and speckle as above": Change(**_SMOOTH),
    "smooth, leaves rough by 20 cm": Change(**_SMOOTH, roughness=dict.fromkeys(LEAVES, 0.2)),
    "smooth, leaves rough and 60 % open": Change(
        **_SMOOTH, roughness=dict.fromkeys(LEAVES, 0.2), transmission={"leaf": 0.6}
    ),
    "smooth, leaves rough and 60 % open, 2048 firings": Change(
        **_SMOOTH, roughness=dict.fromkeys(LEAVES, 0.2), transmission={"leaf": 0.6}, columns=2048
    ),
}
"""The lines of the first table."""

PASTED = ("vegetation", "terrain", "building", "car", "road")


@contextmanager
def applied(change: Change) -> Iterator[None]:
    """The town's surfaces with a change; they are restored afterwards."""
    before = returns._SPECKLE, returns._ROUGHNESS, returns._TRANSMISSION, ground._LIFT
    speckle, rough, open_, lift = (table.copy() for table in before)
    soft = [INDEX[name] for name in (*LEAVES, *SOIL)]
    factor = np.full(len(speckle), change.speckle, np.float32)
    factor[soft] = change.speckle if change.kept is None else change.kept
    for table, values, index in (
        (rough, change.roughness, INDEX),
        (open_, change.transmission, INDEX),
        (lift, change.lift, {name: i for i, name in enumerate(ground.NAMES)}),
    ):
        for name, value in values.items():
            table[index[name]] = value
    returns._SPECKLE, returns._ROUGHNESS, returns._TRANSMISSION, ground._LIFT = speckle * factor, rough, open_, lift
    try:
        yield
    finally:
        returns._SPECKLE, returns._ROUGHNESS, returns._TRANSMISSION, ground._LIFT = before


def town_scans(change: Change, streets: int, seed: int) -> Iterator[Scan]:
    """One scan of each of the first streets of a town."""
    sensor = replace(load_sensor("town"), columns=change.columns)
    town = Town(seed, sensor, streets * STRETCH_FRAMES, noise=Noise(range_std=change.range_std))
    for street in tqdm(range(streets), leave=False):
        yield change.edit(town[street * STRETCH_FRAMES + 7])


def row(name: str, table: NDArray[np.int64]) -> str:
    """A line of the first table."""
    found = Recognition(table, np.zeros((1, 1)))
    ious = found.iou()
    cells = [f"{100 * found.accuracy:.1f}", f"{100 * found.mean_iou:.1f}"]
    cells += [f"{100 * ious[c]:.0f}" if c in ious else "" for c in SHOWN]
    return f"| {name} | {' | '.join(cells)} |"


def paste(into: Image, source: Image, name: str, judge: StreetJudge) -> tuple[Image, NDArray[np.bool_]]:
    """The returns of one class from ``source`` where they are nearer than those of ``into``, and these cells (H, W)."""
    (x, label), (other, labels) = into, source
    distance = [image[0] * judge.deviation[0] + judge.mean[0] for image in (x, other)]
    empty = (x == 0).all(0)
    taken = torch.from_numpy(labels == TRAIN_ID[name]) & (empty | (distance[1] < distance[0]))
    mask = taken.numpy()
    return (torch.where(taken, other, x), np.where(mask, labels, label)), mask


def recognised(judge: StreetJudge, pairs: list[tuple[Image, NDArray[np.bool_]]], name: str) -> float:
    """Share of the given cells that the network takes for a class."""
    hits = total = 0
    for (image, _), cells in pairs:
        predicted = judge.predict(image)
        hits, total = hits + int((predicted[cells] == TRAIN_ID[name]).sum()), total + int(cells.sum())
    return hits / max(1, total)


def exchange(judge: StreetJudge, real: list[Image], town: list[Image]) -> Iterator[str]:
    """The lines of the second table."""
    for name in PASTED:
        shares = []
        for into, source in ((real, real), (town, real), (town, town), (real, town)):
            # Within one set, the class of another scan is pasted, so that all four figures are of pasted returns.
            pairs = [paste(into[i % len(into)], source[(i + 5) % len(source)], name, judge) for i in range(len(town))]
            shares.append(recognised(judge, pairs, name))
        yield f"| {name} | {' | '.join(f'{100 * share:.0f}' for share in shares)} |"


def main() -> None:
    """Prints both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root", type=Path, help="labelled real scans in SemanticKITTI's layout")
    parser.add_argument("--judge", type=Path, required=True, help="archive of lidar-bonnetal")
    parser.add_argument("--streets", type=int, default=50)
    parser.add_argument("--seed", type=int, default=7, help="of the town")
    parser.add_argument("--only", nargs="*", choices=list(CHANGES), default=list(CHANGES), metavar="NAME")
    given = parser.parse_args()

    judge, source = load_archive(given.judge, 1024), open_scans(given.root)
    real = [source[i] for i in range(len(source))]
    print("| 64 x 1024, % | accuracy | mIoU | " + " | ".join(SHOWN) + " |")
    print("|---|" + "---:|" * (len(SHOWN) + 2))
    print(row("real scans", judge.confusion(real)), flush=True)
    for name in given.only:
        with applied(CHANGES[name]):
            print(row(name, judge.confusion(town_scans(CHANGES[name], given.streets, given.seed))), flush=True)
    print("\n| recognised, % | real in real | real in town | town in town | town in real |\n|---|---:|---:|---:|---:|")
    town = [judge.image(scan) for scan in town_scans(Change(), given.streets, given.seed)]
    for line in exchange(judge, [judge.image(scan) for scan in real], town):
        print(line, flush=True)


if __name__ == "__main__":
    main()
