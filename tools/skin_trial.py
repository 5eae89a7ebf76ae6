"""What a skin brings before a network that learnt from real streets, part by part.

    python tools/skin_trial.py SEMANTIC_KITTI --judge FOLDER [--streets 24] [--columns 1024 2048]
    [--places 00 01 ...]

SEMANTIC_KITTI is a folder of real scans in that layout, FOLDER an archive of lidar-bonnetal. A skin
is learnt from the real scans of ``--places`` (all by default), without their labels; the table
compares one scan of each of some streets with the real scans of the other places, or with all if
there are none. docs/research/skin.md has the tables.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from lidar_synth.formats import open_scans
from lidar_synth.geometry.scan import Scan
from lidar_synth.lab.evaluate.distances import frechet_distance
from lidar_synth.lab.evaluate.recognition import Recognition
from lidar_synth.lab.evaluate.street_judge import StreetJudge, load_archive
from lidar_synth.lab.town import STRETCH_FRAMES, Skin, Town, fit_skin, load_skin
from lidar_synth.lab.town.returns import Noise

SHOWN = ("car", "road", "sidewalk", "building", "fence", "vegetation", "terrain", "trunk", "pole")
PARTS = ("mean", "residual", "range", "offset", "missing")
"""The parts of a skin in the order in which the table adds them."""


def only(skin: Skin, parts: tuple[str, ...]) -> Skin:
    """A skin with some of its parts; the others change nothing."""
    arrays = dict(skin.arrays)
    for name in set(PARTS) - set(parts):
        if name in ("offset", "missing"):
            arrays[name] = np.zeros_like(arrays[name])
        else:
            arrays[f"{name}_real"] = arrays[f"{name}_town"]
    return replace(skin, arrays=arrays)


def towns(skin: Skin, count: int, seed: int, names: list[str]) -> dict[str, Town]:
    """The rows of the table."""
    made = {
        "physical model": Town(seed, scans=count),
        "lasers of equal gain": Town(seed, scans=count, noise=Noise(gain_std=0)),
    }
    made["the skin"] = Town(seed, scans=count, skin=skin)
    for k in range(1, len(PARTS)):
        made[f"+ {PARTS[k - 1]}"] = Town(seed, scans=count, skin=only(skin, PARTS[:k]))
    made |= {
        f"without {p}": Town(seed, scans=count, skin=only(skin, tuple(set(PARTS) - {p})))
        for p in PARTS
    }
    made |= {f"{p} alone": Town(seed, scans=count, skin=only(skin, (p,))) for p in PARTS}
    return {name: made[name] for name in names} if names else made


def judged(judge: StreetJudge, scan: Scan) -> tuple[np.ndarray, np.ndarray]:
    """The table of labels and predictions of a scan, and its features."""
    return judge.confusion([scan]), judge.features([scan])


def row(name: str, found: Recognition, real: Recognition) -> str:
    """A line of the table."""
    ious = found.iou()
    cells = [f"{100 * found.accuracy:.1f}", f"{100 * found.mean_iou:.1f}"]
    cells += [f"{frechet_distance(real.features, found.features):.3f}"]
    cells += [f"{100 * ious[c]:.0f}" if c in ious else "" for c in SHOWN]
    return f"| {name} | {' | '.join(cells)} |"


def main() -> None:
    """Prints the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("root", type=Path, help="real scans in SemanticKITTI's layout")
    parser.add_argument("--judge", type=Path, required=True, help="archive of lidar-bonnetal")
    parser.add_argument("--streets", type=int, default=24)
    parser.add_argument("--seed", type=int, default=7, help="of the town that is judged")
    parser.add_argument("--columns", type=int, nargs="+", default=[1024, 2048])
    parser.add_argument(
        "--places", nargs="*", default=[], help="sequences that the skin is learnt from"
    )
    parser.add_argument("--skin", type=Path, help="a skin that was learnt already")
    parser.add_argument("--lasers", action="store_true", help="learn the offsets of lasers, too")
    parser.add_argument("--rows", nargs="*", default=[], help="rows of the table [all]")
    given = parser.parse_args()

    source = open_scans(given.root)
    scans = [source[i] for i in range(len(source))]
    learnt = [s for s in scans if not given.places or s.id.split("/")[0] in given.places]
    others = [s for s in scans if given.places and s.id.split("/")[0] not in given.places] or scans
    skin = (
        load_skin(given.skin)
        if given.skin
        else fit_skin(learnt, licence="CC BY-NC-SA 3.0", lasers=given.lasers)
    )
    judges = {width: load_archive(given.judge, width) for width in given.columns}
    rows = towns(skin, given.streets * STRETCH_FRAMES, given.seed, given.rows)
    results: dict[tuple[str, int], list[tuple[np.ndarray, np.ndarray]]] = {}
    for scan in tqdm(others, desc="real scans"):
        for width, judge in judges.items():
            results.setdefault(("real", width), []).append(judged(judge, scan))
    for street in tqdm(range(given.streets), desc="streets"):
        index = street * STRETCH_FRAMES + 7
        world = next(iter(rows.values())).world(index)
        for name, town in rows.items():
            town._worlds[street] = world
            scan = town[index]
            town._worlds.clear()
            for width, judge in judges.items():
                results.setdefault((name, width), []).append(judged(judge, scan))
    found = {
        key: Recognition(sum(t for t, _ in parts), np.concatenate([f for _, f in parts]))  # type: ignore[arg-type]
        for key, parts in results.items()
    }
    for width in given.columns:
        print(f"\n| 64 x {width}, % | accuracy | mIoU | Frechet | {' | '.join(SHOWN)} |")
        print("|---|" + "---:|" * (len(SHOWN) + 3))
        for name in ("real", *rows):
            print(row(name, found[name, width], found["real", width]), flush=True)


if __name__ == "__main__":
    main()
