"""Does the transfer from sensor to sensor help a segmenter? Trained on one real sensor, tested on
another.

    python tools/transfer_trial.py SEMANTIC_KITTI PANDASET [--seeds 3] [--steps 400] [--jobs 1]
    [--out TABLE.md]

SEMANTIC_KITTI is a root with labels (64 beams, HDL-64E). PANDASET is a folder of Pandar64 frames as
arrays (``sensor_frame/NN.npz`` with points, reflectance, ring and PandaSet's classes).

Every arm has the same network, iterations, order and augmentation, and is tested on the same frames
    of PandaSet: the
last 15. Classes are pooled to those that both datasets label alike. The reference is trained on the
first 15 frames of
PandaSet, of the same street as the test: what the change of sensor, place and labelling costs
    together.
"""

import argparse
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from tqdm import tqdm

from lidar_synth import Scan, load_sensor, open_scans, unfold
from lidar_synth.datasets.classes import IGNORE, NAMES, TRAIN_ID
from lidar_synth.geometry.transfer import Measurement, Mount, Response, Transfer
from lidar_synth.lab.evaluate.segmentation import class_ious, confusion, mean_iou
from lidar_synth.lab.evaluate.segmenter import RangeSegmenter
from lidar_synth.lab.train.precision import faster_in_bfloat16
from lidar_synth.lab.train.segmentation import train_segmenter
from lidar_synth.noise import keyed_rng

COLUMNS = 512
BATCH = 4
WIDTHS = (8, 16, 32, 48)
"""Channels of the segmenter: half of its default, for a short training on a CPU."""
POOLED = {
    "car": ("car", "truck", "other-vehicle"),
    "road": ("road",),
    "sidewalk": ("sidewalk", "parking", "other-ground", "terrain"),
    "building": ("building",),
    "vegetation": ("vegetation", "trunk"),
}
PANDASET = {
    "car": (13, 14, 15, 16, 17, 19, 20, 22, 23),
    "road": (7, 8, 9, 10),
    "sidewalk": (6, 11, 12),
    "building": (41,),
    "vegetation": (5,),
}
HDL64E_FIRINGS = 2170
"""Of each laser in a turn, as the fullest rings of SemanticKITTI have returns."""


def table(classes: dict[str, Sequence[int]]) -> NDArray[np.uint8]:
    """(256,) from a dataset's ids to pooled train ids; other classes are ignored."""
    ids = np.full(256, IGNORE, np.uint8)
    for name, members in classes.items():
        ids[list(members)] = TRAIN_ID[name]
    return ids


def read_pandaset(folder: Path) -> list[Scan]:
    """The frames of PandaSet in order, with pooled classes."""
    sensor = load_sensor("pandar64")
    pooled = table(PANDASET)
    scans = []
    for path in sorted(folder.glob("sensor_frame/*.npz")):
        frame = np.load(path)
        reflectance = frame["reflectance"].astype(np.float32) / 255
        ring = frame["ring"].astype(np.int16)
        scans.append(
            Scan(
                frame["points"],
                reflectance,
                sensor,
                pooled[frame["label"]],
                ring=ring,
                id=path.stem,
            )
        )
    return scans


def read_semantic_kitti(root: Path) -> list[Scan]:
    """The scans of SemanticKITTI with pooled classes."""
    pooled = table({name: [TRAIN_ID[n] for n in members] for name, members in POOLED.items()})
    sensor = replace(load_sensor("hdl64e_semantic_kitti"), firings=HDL64E_FIRINGS)
    scans = open_scans(root, sensor=sensor)
    return [replace(scan, label=pooled[scan.label]) for scan in scans]


def road_height(scans: Sequence[Scan]) -> float:
    """Median height of the road within 12 m of the sensor, metres."""
    near = [
        s.points[(s.label == TRAIN_ID["road"]) & (np.linalg.norm(s.points, axis=1) < 12), 2]
        for s in scans
    ]
    return float(np.median(np.concatenate(near)))


@dataclass
class Images:
    """Labelled range images of one sensor: (n, H, W) tensors, and (H, W) sine of the elevation."""

    range: Tensor
    reflectance: Tensor
    label: Tensor
    height: Tensor

    @classmethod
    def of(cls, scans: Sequence[Scan], columns: int = COLUMNS) -> "Images":
        """One row per laser, the nearest return of each cell."""
        views = [
            unfold(scan, replace(scan.sensor.by_beams(), columns=columns, firings=None))
            for scan in scans
        ]
        stacks = [
            np.stack(v)
            for v in zip(*((v.range, v.reflectance, v.label) for v in views), strict=True)
        ]
        return cls(
            *map(torch.from_numpy, stacks),
            torch.from_numpy(np.sin(views[0].sensor.ray_angles()[0])),
        )

    def batches(self, seed: int) -> Iterator[dict[str, Tensor]]:
        """Endless batches of random images, turned and mirrored."""
        rng = keyed_rng(seed)
        while True:
            parts = []
            for i in rng.choice(len(self.range), BATCH, replace=False):
                turn = int(rng.integers(self.range.shape[-1]))
                mirror = bool(rng.integers(2))
                images = [t[i].roll(turn, -1) for t in (self.range, self.reflectance, self.label)]
                parts.append([t.flip(-1) if mirror else t for t in images])
            names = ("range", "reflectance", "label")
            yield {n: torch.stack(p) for n, p in zip(names, zip(*parts, strict=True), strict=True)}

    def singly(self) -> Iterator[dict[str, Tensor]]:
        """One image after another."""
        for i in range(len(self.range)):
            yield {n: getattr(self, n)[i : i + 1] for n in ("range", "reflectance", "label")}


class Mixed(nn.Module):
    """A network in mixed precision, where that is faster."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, x: Tensor) -> Tensor:
        with torch.autocast("cpu", torch.bfloat16, enabled=faster_in_bfloat16()):
            logits: Tensor = self.network(x)
        return logits.float()


def run(
    train: Images, tests: dict[str, Images], steps: int, seed: int, kept: Path | None
) -> dict[str, NDArray[np.int64]]:
    """Train one segmenter, or read its result; its confusion matrix on every test set."""
    if kept is not None and kept.is_file():
        return dict(np.load(kept))
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    network = Mixed(RangeSegmenter(widths=WIDTHS))
    train_segmenter(network, train.batches(seed), train.height, steps, progress=False)
    found = {name: confusion(network, test.singly(), test.height) for name, test in tests.items()}
    if kept is not None:
        np.savez(kept, **found)
    return found


def respond(scans: Sequence[Scan], response: Response) -> list[Scan]:
    """The same returns with the reflectance of another sensor."""
    return [replace(s, reflectance=response(s.reflectance).astype(np.float32)) for s in scans]


def arms(kitti: list[Scan], panda: list[Scan]) -> dict[str, tuple[Images, dict[str, Images]]]:
    """{arm: (training set, {test: images})}."""
    first = panda[:15]
    last = panda[-15:]
    pandar = panda[0].sensor
    hdl64e = kitti[0].sensor
    mount = Mount(z=round(road_height(kitti) - road_height(first), 2))
    response = Response.match(kitti, first)
    back = Response.match(first, kitti)
    print(f"the Pandar64 is mounted {mount.z:+.2f} m above the HDL-64E")
    geometry = Transfer(pandar, mount)
    whole = replace(geometry, measurement=Measurement(response=response))
    reverse = Transfer(hdl64e, Mount(z=-mount.z), Measurement(response=back))
    rng = keyed_rng(0)
    test = {"PandaSet": Images.of(last)}
    return {
        "SemanticKITTI as it is": (
            Images.of(kitti),
            test | {"PandaSet as HDL-64E": Images.of([reverse(s, rng) for s in last])},
        ),
        "SemanticKITTI as Pandar64": (Images.of([whole(s, rng) for s in kitti]), test),
        "PandaSet, first 15 frames (reference)": (Images.of(first), test),
        "SemanticKITTI as Pandar64, reflectance as it is": (
            Images.of([geometry(s, rng) for s in kitti]),
            test,
        ),
        "SemanticKITTI as it is, reflectance matched": (Images.of(respond(kitti, response)), test),
    }


def report(results: dict[tuple[str, str], list[NDArray[np.int64]]]) -> str:
    """A Markdown table: mIoU and IoU of every class, mean and standard deviation over seeds; and
    what is recovered."""
    classes = [TRAIN_ID[name] for name in POOLED]
    lines = [
        f"| trained on | tested on | mIoU, % | {' | '.join(NAMES[c] for c in classes)} | "
        "recovered |"
    ]
    lines.append("|---|---|---:|" + "---:|" * (len(classes) + 1))
    keys = list(results)
    reference = next(key for key in keys if "reference" in key[0])
    start, goal = (np.array([mean_iou(t) for t in results[k]]) for k in (keys[0], reference))
    for key in keys:
        scores = np.array([mean_iou(t) for t in results[key]])
        ious = np.mean([class_ious(t)[classes] for t in results[key]], 0)
        share = (scores - start) / (goal - start)
        cells = " | ".join(f"{100 * v:.0f}" for v in ious)
        spread = (
            f"{100 * scores.mean():.1f} ± {100 * scores.std(ddof=1) if len(scores) > 1 else 0:.1f}"
        )
        lines.append(f"| {key[0]} | {key[1]} | {spread} | {cells} | {100 * share.mean():.0f} % |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("kitti", type=Path)
    parser.add_argument("pandaset", type=Path)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--columns", type=int, default=COLUMNS, help="of the range images")
    parser.add_argument("--jobs", type=int, default=1, help="processes, of one thread each")
    parser.add_argument("--out", type=Path, help="file for the table")
    parser.add_argument(
        "--work", type=Path, help="folder for the result of each training, to resume"
    )
    given = parser.parse_args()
    if given.work:
        given.work.mkdir(parents=True, exist_ok=True)
    sets = arms(read_semantic_kitti(given.kitti), read_pandaset(given.pandaset))
    order = list(sets)
    jobs = [
        (arm, seed)
        for part in (order[:3], order[3:])
        for seed in range(given.seeds)
        for arm in part
    ]
    results: dict[tuple[str, str], list[NDArray[np.int64]]] = {
        (arm, test): [] for arm, (_, tests) in sets.items() for test in tests
    }
    with ProcessPoolExecutor(given.jobs, get_context("spawn")) as pool:
        kept = [
            given.work and given.work / f"{order.index(arm)}-{given.steps}-{seed}.npz"
            for arm, seed in jobs
        ]
        futures = [
            pool.submit(run, *sets[a], given.steps, s, k)
            for (a, s), k in zip(jobs, kept, strict=True)
        ]
        for (arm, seed), future in zip(tqdm(jobs, "trainings"), futures, strict=True):
            for test, found in future.result().items():
                results[arm, test].append(found)
                print(
                    f"{arm}, tested on {test}, seed {seed}: {100 * mean_iou(found):.1f} %",
                    flush=True,
                )
    text = report(results)
    print(text)
    if given.out:
        given.out.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
