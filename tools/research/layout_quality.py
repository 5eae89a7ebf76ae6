"""Does a layout model do what its layouts say? Figures and images of unseen layouts.

    python tools/research/layout_quality.py NAME=MODEL[:STEPS] ... [--count 64] [--seed 1]
        [--guidance 1] [--cast] [--picture OUT.png] [--dump OUT.json] [--intervals 200]

Layouts are those of scans of a town that no model was trained on, each from another stretch of
road; --cast casts their objects, as the commands do. The first row is the town's own scans: boxes
are larger than objects, so that some of their rays return from behind. Other models are compared by
the distances alone, with the labels or images of the same scans as conditions.
"""

import json
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import gallery
from gallery import save
from model_card import (
    SEED,
    Asked,
    Comparison,
    apart,
    needs_images,
    table,
    with_images,
)
from tqdm import tqdm
from typer import run

from lidar_synth import ObjectBank, Scan, Town, layout_of, load_generator
from lidar_synth.files.markdown import escape_markdown
from lidar_synth.generate.boxed import Drawer
from lidar_synth.geometry.layout import Layout
from lidar_synth.lab.evaluate.layouts import LayoutAgreement, layout_agreement
from lidar_synth.lab.evaluate.segmentation import load_judge
from lidar_synth.lab.town import STRETCH_FRAMES
from lidar_synth.viz import render

SIZE = (1100, 660)
"""Width and height of one of them, in pixels."""
SHOWN = 6
"""Examples in the picture."""


def generate(
    asked: Asked, guidance: float, real: list[Scan], objects: Drawer | None
) -> tuple[str | None, list[Scan]]:
    """The model's condition, and one scan of it for each real scan."""
    generator = load_generator(asked.model)
    strength = guidance if generator.condition == "layout" else 1.0
    stood = objects if generator.condition == "layout" else None
    made = []
    for i, scan in enumerate(tqdm(real, desc=asked.name, unit="scan")):
        given = scan if generator.condition else None
        made += generator.scans(
            SEED, [i], given, stood, steps=asked.steps, guidance=strength
        )
    return generator.condition, made


def line(name: str, found: LayoutAgreement | None) -> str:
    """A row of the second table."""
    if found is None:
        return f"| {escape_markdown(name)} | - | - | - | - | - | - |"
    shares = " | ".join(
        f"{100 * s:.2f}"
        for s in (found.inside_share, found.filled_share, found.kept_share)
    )
    return f"| {escape_markdown(name)} | {shares} | {found.points} | {found.boxes} | {found.seen} |"


def draw(path: Path, made: list[Scan], real: list[Scan], layouts: list[Layout]) -> None:
    """Write generated scans with the boxes of their layouts beside the scans of the layouts."""
    rows = []
    for scan, own, layout in zip(
        *(apart(some, SHOWN) for some in (made, real, layouts)), strict=True
    ):
        titled = {"generated": scan, "scan of the layout": own}
        rows.append(
            [
                (title, render(replace(one, boxes=layout.boxes), "label", size=SIZE))
                for title, one in titled.items()
            ]
        )
    save(path, gallery.draw(rows), 1500, 256)


def print_agreement(counts: dict[str, LayoutAgreement | None]) -> None:
    """Print the second table."""
    print(
        "| scans | points of boxed classes in a box, % | boxes that 20 rays meet with 10 points, % "
        "| boxes with 20 points in the town's scan with 10 points, % | points | boxes | boxes |\n"
        "|---|---:|---:|---:|---:|---:|---:|"
    )
    for name, found in counts.items():
        print(line(name, found))


def streets(seed: int, count: int) -> Town:
    """A town without motion, of as many streets."""
    scans = count * STRETCH_FRAMES
    return Town(seed, "hdl64e_lasers", scans, interval=2.0, motion=False)


def main(
    models: list[str],
    count: int = 64,
    seed: int = 1,
    guidance: float = 1.0,
    cast: bool = False,
    distances: bool = False,
    picture: Path | None = None,
    intervals: int = 200,
    dump: Path | None = None,
) -> None:
    """Prints the tables; writes the picture and the counts."""
    town = streets(seed, count)
    real = [town[i * STRETCH_FRAMES] for i in tqdm(range(count), desc="town")]
    layouts = [layout_of(scan) for scan in real]
    every = [Asked.parse(text) for text in models]
    own = layout_agreement(real, layouts, real)
    objects = ObjectBank.from_town_shapes() if cast else None
    counts: dict[str, LayoutAgreement | None] = {"the town's own scans": own}
    made = {}
    with TemporaryDirectory() as folder:
        if needs_images(every):
            real = with_images(real, town, Path(folder))
        for asked in every:
            kind, scans = generate(asked, guidance, real, objects)
            made[asked.name] = scans
            follows = kind == "layout"
            found = layout_agreement(scans, layouts, real) if follows else None
            counts[asked.name] = found
    print(f"{count} layouts of the town of seed {seed}\n")
    print_agreement(counts)
    if picture:
        draw(picture, next(iter(made.values())), real, layouts)
    if distances:
        comparison = Comparison(real, load_judge(), intervals)
        sets = [comparison.measure(name, scans) for name, scans in made.items()]
        print(f"\n{table(sets)}")
    if dump:
        values = {name: found and found._asdict() for name, found in counts.items()}
        dump.write_text(json.dumps(values, indent=1))


if __name__ == "__main__":
    run(main)
