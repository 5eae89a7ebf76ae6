"""Can a small classifier tell where an object was removed from a scan?

Cars are removed from scans of the town and, with --labelled and --boxed, from real scans of KITTI.
For each there is a control. In the town it is the same place in the scan that the town casts
without these cars, which also shows how true the filled hole is. In a real scan it is another place
of the unedited scan: the same box, turned about the sensor to a free place on ground, so at the
same distance and of the same size; of the free places, the one whose surroundings have the most
similar classes. A small convolutional network sees both places in the range image (range relative
to the object's, reflectance, lost returns, number of points), is trained on some scans and tested
on others.

    python tools/research/surgery_trial.py --town 40 --labelled $LIDAR_SYNTH_LABELLED_SCANS/semantic_kitti
"""

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn
from torch.utils.data import ConcatDataset
from tqdm import tqdm

from lidar_synth import Boxes, Scan, Source, Town, load_generator, open_scans
from lidar_synth.generate.generator import Generator
from lidar_synth.geometry.projection import locate, project
from lidar_synth.lab.town.world import World
from lidar_synth.labels.boxes import turn_boxes
from lidar_synth.labels.edit.removal import remove_returns, returns_of
from lidar_synth.labels.ground import ground_under
from lidar_synth.labels.objects import instances_of
from lidar_synth.noise import keyed_rng

PATCH = 24, 32
FOLDS = 5
LEAST = 50
"""Minimum number of returns of a car that is removed."""
NEAR = 4.0
FAR = 40.0
"""Distances of removed cars, metres."""
TRIES = 80
"""Number of places that are tried for a control."""
MOST = 8
"""Maximum number of cars that are removed from one scan."""


def cars_of(scan: Scan) -> list[Boxes]:
    """The boxes of a scan's cars; without boxes, the extents of its instances."""
    if scan.boxes is None and scan.instance is None:
        return []
    if scan.boxes is None:
        found = [
            o.scan.boxes
            for o in instances_of(scan, LEAST)
            if o.scan.label is not None and o.scan.label[0] == 0
        ]
    else:
        found = [
            scan.boxes[[i]]
            for i, name in enumerate(scan.boxes.names)
            if name in ("Car", "Van")
        ]
    return [
        b for b in found if b is not None and NEAR < np.hypot(*b.values[0, :2]) < FAR
    ]


def control(
    scan: Scan, box: Boxes, rng: np.random.Generator
) -> NDArray[np.float32] | None:
    """The box at a free place at the same distance, that with the most similar surroundings, or
    None."""
    best = None
    similar = -1.0
    here = surroundings(scan, box)
    for angle in rng.uniform(-np.pi, np.pi, TRIES):
        there = turn_boxes(box, angle)
        values = there.values[0]
        ground = ground_under(scan, values)
        if ground is not None and ground.free and ground.encloses:
            alike = float(np.minimum(here, surroundings(scan, there)).sum())
            if alike > similar:
                values[2] = ground.height + values[5] / 2
                best = values
                similar = alike
    return best


class Emptied(Town):
    """The town without some objects of its stretches.

    Args:
        town: the whole one.
        instances: numbers of the objects that are missing.
    """

    def __init__(self, town: Town, instances: Sequence[int]) -> None:
        super().__init__(town.seed, town.sensor, len(town), town.interval)
        self._gone = list(instances)

    def world(self, index: int) -> World:
        """The stretch of road of a scan, without these objects."""
        world = super().world(index)
        kept = ~np.isin(world.surfaces.instance[world.faces], self._gone)
        movers = [mover for mover in world.movers if mover.instance not in self._gone]
        return replace(
            world,
            triangles=world.triangles[kept],
            faces=world.faces[kept],
            movers=movers,
        )


class Place(NamedTuple):
    """Where a car is removed: its returns (N,), its box (7,), and the box (7,) of the control."""

    mine: NDArray[np.bool_]
    box: NDArray[np.float32]
    control: NDArray[np.float32]


class Collected(NamedTuple):
    """Patches of edited places by edit and of controls, the scan of each place, and by edit the
    seconds per scan and the cells of ``fidelity`` (the latter without a truth: none)."""

    edited: dict[str, list[NDArray[np.float32]]]
    controls: list[NDArray[np.float32]]
    groups: list[int]
    seconds: dict[str, float]
    cells: dict[str, list[NDArray[np.float64]]]


def places_of(scan: Scan, anywhere: bool, number: int) -> list[Place]:
    """The cars that are removed from a scan, with controls in other places or in their own."""
    rng = keyed_rng(0, number)
    found = []
    for box in cars_of(scan):
        mine = returns_of(scan, box)
        if mine.sum() >= LEAST:
            there = control(scan, box, rng) if anywhere else box.values[0]
            if there is not None:
                found.append(Place(mine, box.values[0], there))
    return found[:MOST]


def fidelity(
    scan: Scan, places: list[Place], result: Scan, truth: Scan
) -> NDArray[np.float64]:
    """(n, 3) for each cell of the holes: whether the edited scan and the truth agree on having a
    return; and, nan without both returns, whether they are at the same range (to 0.3 m or 3 %) and
    of the same class."""
    cells = locate(scan.points, scan.sensor).cell
    hole = np.unique(cells[np.any([place.mine for place in places], 0) & (cells >= 0)])
    (a, b), (c, d) = (
        (image.range.ravel()[hole], image.label.ravel()[hole])
        for image in (project(one, scan.sensor, ["label"]) for one in (result, truth))
    )
    both = (a > 0) & (c > 0)
    near = np.abs(a - c) < np.maximum(0.3, 0.03 * c)
    return np.stack(
        [
            (a > 0) == (c > 0),
            np.where(both, near, np.nan),
            np.where(both, b == d, np.nan),
        ],
        1,
    )


def surroundings(scan: Scan, box: Boxes) -> NDArray[np.float64]:
    """(20,) shares of the classes of returns within 2.5 m of a box, other objects included; alike
    without labels."""
    if scan.label is None:
        return np.zeros(20)
    inner, outer = (
        Boxes(
            box.values + np.array([0, 0, 0, 2 * m, 2 * m, 2 * m, 0], np.float32),
            box.names,
        )
        for m in (0.1, 2.5)
    )
    around = outer.contain(scan.points)[0] & ~inner.contain(scan.points)[0]
    count = np.bincount(np.minimum(scan.label[around], 19), minlength=20)
    return np.asarray(count / max(count.sum(), 1))


def patch(scan: Scan, box: NDArray[np.float32]) -> NDArray[np.float32]:
    """(4, *PATCH) the place of a box in the range image, with a margin."""
    image = project(scan, channels=["reflectance"])
    cells = locate(scan.points, scan.sensor).cell
    rows, columns = scan.sensor.shape
    corners = Boxes(box, ("Car",)).corners()[0]
    azimuth = -np.arctan2(corners[:, 1], corners[:, 0])
    middle = -np.arctan2(box[1], box[0])
    offset = (azimuth - middle + np.pi) % (2 * np.pi) - np.pi
    elevation = np.arctan2(corners[:, 2], np.hypot(corners[:, 0], corners[:, 1]))
    row = np.searchsorted(-scan.sensor.edges[1:-1], -elevation)
    across = np.linspace(1.3 * offset.min(), 1.3 * offset.max(), PATCH[1])
    column = ((((middle + across) / np.pi + 1) / 2 % 1) * columns).astype(int) % columns
    high = max(int(row.max() - row.min()), 4)
    down = (
        np.linspace(row.min() - 0.15 * high, row.max() + 0.15 * high, PATCH[0])
        .round()
        .astype(int)
        .clip(0, rows - 1)
    )
    at = np.ix_(down, column)
    count = np.bincount(cells[cells >= 0], minlength=rows * columns).reshape(
        rows, columns
    )
    seen = image.range[at] > 0
    relative = np.where(
        seen, np.log(np.maximum(image.range[at], 0.1) / np.hypot(*box[:2])), 0
    ).clip(-1.5, 1.5)
    assert image.reflectance is not None
    return np.stack([relative, image.reflectance[at], seen, count[at] / 2]).astype(
        np.float32
    )


def edits(model: Generator | None, starts: list[float]) -> dict[str, object]:
    """The compared edits: {name: (scan, parts, number) -> scan}."""

    def hole(scan: Scan, parts: list, number: int) -> Scan:
        return scan[~np.any([mine for mine, _ in parts], 0)]

    def filled(
        scan: Scan, parts: list, number: int, start: float | None = None
    ) -> Scan:
        return remove_returns(
            scan, parts, None if start is None else model, number, start
        )

    return {"hole left open": hole, "filled by geometry": filled} | {
        f"drawn by the flow from t = {start}": partial(filled, start=start)
        for start in starts
    }


def collect(source: Source, ways: dict) -> Collected:
    """All places of a source; those of the town have their controls in the scan that it casts
    without the cars."""
    found = Collected(
        {name: [] for name in ways},
        [],
        [],
        dict.fromkeys(ways, 0.0),
        {n: [] for n in ways},
    )
    number = 0
    for i in tqdm(range(len(source)), leave=False, disable=None):
        scan = source[i]
        places = places_of(scan, not isinstance(source, Town), number)
        if not places:
            continue
        truth = scan
        if isinstance(source, Town):
            assert scan.instance is not None
            truth = Emptied(
                source,
                [int(np.bincount(scan.instance[p.mine]).argmax()) for p in places],
            )[i]
        for name, way in ways.items():
            before = time.perf_counter()
            result = way(scan, [(place.mine, place.box) for place in places], number)
            found.seconds[name] += time.perf_counter() - before
            found.edited[name].extend(patch(result, place.box) for place in places)
            if isinstance(source, Town):
                found.cells[name].append(fidelity(scan, places, result, truth))
        found.controls.extend(patch(truth, place.control) for place in places)
        found.groups.extend([number] * len(places))
        number += 1
    return found._replace(
        seconds={name: value / max(number, 1) for name, value in found.seconds.items()}
    )


def auc(edited: list, controls: list, groups: list, epochs: int, seed: int) -> float:
    """Area under the ROC curve on unseen scans, all folds together."""
    x = torch.from_numpy(np.stack(edited + controls))
    y = torch.tensor([1.0] * len(edited) + [0.0] * len(controls))
    fold = torch.from_numpy(
        keyed_rng(1).permutation(max(groups) + 1)[np.array(groups * 2)] % FOLDS
    )
    scores = torch.zeros(len(y))
    for k in range(FOLDS):
        scores[fold == k] = _scores(
            x[fold != k], y[fold != k], x[fold == k], epochs, seed
        )
    order = scores.argsort()
    rank = torch.empty(len(y))
    rank[order] = torch.arange(1.0, len(y) + 1)
    positive = y.sum()
    return float(
        (rank[y == 1].sum() - positive * (positive + 1) / 2)
        / (positive * (len(y) - positive))
    )


def surroundings_alone(patches: list) -> list:
    """Patches without their middle, where the object was: what the choice of places alone gives
    away."""
    masked = [patch.copy() for patch in patches]
    for each in masked:
        each[:, 3:-3, 4:-4] = 0
    return masked


def _scores(
    x: torch.Tensor, y: torch.Tensor, unseen: torch.Tensor, epochs: int, seed: int
) -> torch.Tensor:
    """Train a network, and return the logits of unseen patches, standardised to be comparable
    between folds."""
    torch.manual_seed(seed)
    net = nn.Sequential(
        nn.Conv2d(4, 16, 3, padding=1),
        nn.ReLU(),
        nn.MaxPool2d(2),
        nn.Conv2d(16, 32, 3, padding=1),
        nn.ReLU(),
        nn.MaxPool2d(2),
        nn.Conv2d(32, 32, 3, padding=1),
        nn.ReLU(),
        nn.AdaptiveAvgPool2d((3, 4)),
        nn.Flatten(),
        nn.Dropout(0.3),
        nn.Linear(384, 1),
    )
    optimizer = torch.optim.AdamW(net.parameters(), 2e-3, weight_decay=0.02)
    for _ in range(epochs):
        for part in torch.randperm(len(x)).split(32):
            batch = x[part] if torch.rand(()) < 0.5 else x[part].flip(-1)
            loss = nn.functional.binary_cross_entropy_with_logits(
                net(batch)[:, 0], y[part]
            )
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    net.eval()
    with torch.no_grad():
        scores: torch.Tensor = (net(unseen) + net(unseen.flip(-1)))[:, 0]
    return (scores - scores.mean()) / scores.std()


def main() -> None:
    """Print a table of AUC by source and edit."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--town", type=int, default=0, help="scans of the town")
    parser.add_argument(
        "--labelled", nargs="*", default=[], help="SemanticKITTI's folders"
    )
    parser.add_argument(
        "--boxed", nargs="*", default=[], help="folders of KITTI's object set"
    )
    parser.add_argument("--model", default="town")
    parser.add_argument("--starts", type=float, nargs="*", default=[0.6])
    parser.add_argument("--epochs", type=int, default=25)
    parser.add_argument(
        "--save", help="beginning of the names of files for the patches"
    )
    parser.add_argument("--seeds", type=int, default=3)
    arguments = parser.parse_args()
    ways = edits(load_generator(arguments.model), arguments.starts)
    sources: dict[str, Source] = (
        {"town": Town(seed=977, scans=arguments.town)} if arguments.town else {}
    )
    if roots := arguments.labelled + arguments.boxed:
        sources["KITTI"] = ConcatDataset([open_scans(root) for root in roots])
    for name, source in sources.items():
        found = collect(source, ways)
        if arguments.save:
            np.savez(
                f"{arguments.save}-{name}.npz",
                **found.edited,
                controls=found.controls,
                groups=found.groups,
            )  # type: ignore[arg-type]
        print(f"{name}: {len(found.controls)} cars in {max(found.groups) + 1} scans")

        def show(
            name: str,
            edited: list,
            controls: list,
            more: str,
            groups: list[int] = found.groups,
        ) -> None:
            values = [
                auc(edited, controls, groups, arguments.epochs, seed)
                for seed in range(arguments.seeds)
            ]
            print(
                f"  {name:<36} AUC {np.mean(values):.3f} +- {np.std(values):.3f}{more}"
            )

        around = found.edited["filled by geometry"], found.controls
        show(
            "surroundings alone",
            *(surroundings_alone(patches) for patches in around),
            more="",
        )
        for way, patches in found.edited.items():
            show(
                way,
                patches,
                found.controls,
                f"   {found.seconds[way]:.2f} s a scan" + true_cells(found.cells[way]),
            )


def true_cells(cells: list[NDArray[np.float64]]) -> str:
    """The fidelity of all cells in words; nothing without a truth."""
    if not cells:
        return ""
    shares = np.nanmean(np.concatenate(cells), 0)
    return "; true: return or none {:.1%}, range {:.1%}, class {:.1%}".format(*shares)


if __name__ == "__main__":
    main()
