"""The figures and the pictures of docs/models.md: how near generated scans come to scans of the town.

    python tools/model_card.py NAME=MODEL[:STEPS] ... [--count 512] [--pictures OUT]

    python tools/model_card.py "student, 4 steps=town" "teacher, 50 steps=RUN/town_teacher.safetensors:50" \\
        "teacher, 4 steps=RUN/town_teacher.safetensors:4" --pictures docs/models

Every model makes scans from the same noise. They stand beside scans of a town that no model was trained on (seed 1);
the first row is a third town (seed 2), which is as near as different streets of one kind come.

Models with a condition have a card of their own: tools/condition_card.py.
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image
from tqdm import tqdm

from lidar_synth.classes import IGNORE, NAMES, TRAIN_ID
from lidar_synth.generator import load_generator
from lidar_synth.metrics import Score, evaluate
from lidar_synth.metrics.segmentation import Judge, class_ious, load_judge, mean_iou
from lidar_synth.projection import project, unproject
from lidar_synth.scan import Scan
from lidar_synth.town import STRETCH_FRAMES, Town
from lidar_synth.viz import Orbit, render, write_view

REFERENCE, OTHER = 1, 2
"""Seeds of the towns to compare with."""
SEED = 1
"""Of the noise."""
CLASSES = ("road", "sidewalk", "terrain", "car", "building", "fence", "vegetation", "trunk", "pole")
TILES = 16
CLOSE = 4
NEAR = Orbit(azimuth=160, elevation=22, distance=27, field=45, target=(5, 0, -1)).camera()
"""Where cars and poles can be told from each other."""


def generate(model: str, steps: int | None, count: int) -> list[Scan]:
    """Scans of one model, which all models make from the same noise."""
    generator = load_generator(model)
    indices = tqdm(range(count), desc=Path(model).stem, unit="scan")
    return [generator.scans(SEED, [i], steps=steps)[0] for i in indices]


def relabelled(scan: Scan, other: Scan) -> Scan:
    """A scan on the grid, each return with the label that another one has in its cell."""
    image, labels = project(scan, scan.sensor), project(other, scan.sensor, ["label"]).channels["label"]
    image.channels["label"] = np.where(image.mask, labels, IGNORE).astype(np.uint8)
    return replace(unproject(image), id=scan.id, domain=scan.domain)


def town(seed: int, count: int) -> list[Scan]:
    """Scans of one town, each on another street: neighbouring ones would make a town of three or four streets."""
    source = Town(seed, scans=count * STRETCH_FRAMES, interval=1.0)
    return [source[i * STRETCH_FRAMES] for i in tqdm(range(count), desc=f"town {seed}", unit="scan")]


def rows(name: str, reference: Sequence[Scan], scans: Sequence[Scan], judge: Judge) -> tuple[str, str]:
    """A line of the table, and one of the second table: what the segmenter sees as the labels say, class by class."""
    values = [f"{score.value:.4g}" for score in _scores(reference, scans, judge)]
    mean, ious = float("nan"), np.full(len(NAMES), np.nan)
    if scans[0].label is not None:
        table = judge.agreement(scans)
        mean, ious = mean_iou(table), class_ious(table)
    classes = [f"{100 * ious[TRAIN_ID[one]]:.0f}" for one in CLASSES]
    return f"| {name} | {' | '.join(values)} | {100 * mean:.1f} |", f"| {name} | {' | '.join(classes)} |"


def header(reference: Sequence[Scan], judge: Judge) -> str:
    """The table's head, in the order of ``rows``."""
    scores = _scores(reference[:2], reference[2:4], judge, progress=False)
    names = [f"{score.metric} ({score.protocol})" for score in scores]
    return f"| scans | {' | '.join(names)} | mIoU with the town segmenter, % |\n|---|{'---:|' * (len(names) + 1)}"


def _scores(reference: Sequence[Scan], scans: Sequence[Scan], judge: Judge, progress: bool = True) -> list[Score]:
    """By R2Flow's measures on the town's grid, by the segmenter's features, and by LiDM's measures."""
    own = evaluate(reference, scans, "town", {"the town segmenter": judge.features}, progress=progress)
    return own + evaluate(reference, scans, "lidm", progress=progress)


def picture(path: Path, scans: Sequence[Scan], title: str) -> None:
    """A sheet of scans as a PNG of few colours: small enough for a repository."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_view(path, list(scans), title=title)
    shrink(path)


def near(path: Path, scans: Sequence[Scan], reference: Sequence[Scan]) -> None:
    """Fewer scans, from nearer by: generated ones on the left, the town's on the right."""
    pairs = zip(scans, reference, strict=True)
    seen = [[render(scan, "label", camera=NEAR, size=(900, 480), boxes=False) for scan in pair] for pair in pairs]
    Image.fromarray(np.vstack([np.hstack(pair) for pair in seen])).save(path)
    shrink(path)


def shrink(path: Path) -> None:
    """Fewer pixels and colours in a PNG."""
    image = Image.open(path).convert("RGB")
    width = 1500
    image = image.resize((width, round(image.height * width / image.width)), Image.Resampling.LANCZOS)
    # Few cells are cars or poles: a palette by number of pixels would lose their colours, one by coverage alone the
    # background's.
    image.quantize(256, Image.Quantize.MAXCOVERAGE, kmeans=1, dither=Image.Dither.NONE).save(path, optimize=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="+", metavar="NAME=MODEL[:STEPS]")
    parser.add_argument("--count", type=int, default=512, help="scans of every row")
    parser.add_argument("--pictures", type=Path, help="folder for sheets of the first model and of the town")
    given = parser.parse_args()

    judge = load_judge()
    reference = town(REFERENCE, given.count)
    lines = [rows("another town", reference, town(OTHER, given.count), judge)]
    for i, text in enumerate(given.models):
        name, model = text.split("=", 1)
        model, _, steps = model.partition(":")
        scans = generate(model, int(steps) if steps else None, given.count)
        lines.append(rows(name, reference, scans, judge))
        if i == 0 and given.pictures:
            apart = np.linspace(0, given.count - 1, TILES).astype(int)
            picture(given.pictures / "generated.png", scans[:TILES], f"{name}: {TILES} scans that were not chosen")
            picture(given.pictures / "town.png", [reference[k] for k in apart], f"{TILES} scans of the town")
            near(given.pictures / "near.png", scans[:CLOSE], [reference[k] for k in apart[:CLOSE]])
    print(f"{given.count} scans a row, {given.count} of the town\n\n{header(reference, judge)}")
    print("\n".join(line for line, _ in lines))
    print(f"\n| IoU with the segmenter, % | {' | '.join(CLASSES)} |\n|---|{'---:|' * len(CLASSES)}")
    print("\n".join(classes for _, classes in lines))


if __name__ == "__main__":
    main()
