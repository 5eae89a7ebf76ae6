"""Does a layout model do what its layouts say? Figures and images of unseen layouts.

    python tools/research/layout_quality.py NAME=MODEL[:STEPS] ... [--count 64] [--seed 1] [--guidance 1]
                                   [--picture OUT.png]
                                   [--dump OUT.json] [--intervals 200]

Layouts are those of scans of a town that no model was trained on, each from another stretch of
road. The first row is the town's own scans: boxes are larger than objects, so that some of their
rays return from behind. Other models are compared by the distances alone, with the labels or images
of the same scans as conditions.
"""

import argparse
import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from model_card import (
    SEED,
    Comparison,
    Measured,
    needs_images,
    shrink,
    table,
    with_images,
)
from tqdm import tqdm

from lidar_synth import Scan, Town, layout_of, load_generator
from lidar_synth.files.markdown import escape_markdown
from lidar_synth.geometry.layout import Layout
from lidar_synth.lab.evaluate.layouts import LayoutAgreement, layout_agreement
from lidar_synth.lab.evaluate.segmentation import load_judge
from lidar_synth.lab.town import STRETCH_FRAMES
from lidar_synth.viz import render

SHOWN = 6
"""Examples in the picture."""


def generate(
    model: str, steps: int | None, guidance: float, real: list[Scan]
) -> tuple[str | None, list[Scan]]:
    """The model's condition, and one scan of it for each real scan."""
    generator = load_generator(model)
    made = []
    for i, scan in enumerate(tqdm(real, desc=Path(model).stem, unit="scan")):
        given = scan if generator.condition else None
        strength = guidance if generator.condition == "layout" else 1.0
        made += generator.scans(SEED, [i], given, steps=steps, guidance=strength)
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
    figure = Figure(
        figsize=(15, 4.6 * len(made)), facecolor="#1e1014", layout="constrained"
    )
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(made), 2, squeeze=False)
    for axes, scan, own, layout in zip(grid, made, real, layouts, strict=True):
        scan.boxes = own.boxes = layout.boxes
        for axis, one, title in zip(
            axes, (scan, own), ("generated", "scan of the layout"), strict=True
        ):
            axis.imshow(render(one, "label", size=(1100, 660)))
            axis.set_title(title, color="#9aa0ad", fontsize=9, loc="left")
            axis.set_axis_off()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)
    shrink(path)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("models", nargs="+", metavar="NAME=MODEL[:STEPS]")
    parser.add_argument("--count", type=int, default=64, help="number of layouts")
    parser.add_argument("--seed", type=int, default=1, help="of the unseen town")
    parser.add_argument("--guidance", type=float, default=1.0, help="of layout models")
    parser.add_argument(
        "--distances", action="store_true", help="compare the sets of scans, too (slow)"
    )
    parser.add_argument("--picture", type=Path, help="PNG of the first model's scans")
    parser.add_argument(
        "--intervals",
        type=int,
        default=200,
        help="resamples for 95 %% intervals; 0 = none",
    )
    parser.add_argument("--dump", type=Path, help="JSON of the counts")
    given = parser.parse_args()
    with TemporaryDirectory() as folder:
        report(given, Path(folder))


def report(given: argparse.Namespace, folder: Path) -> None:
    """Print the tables; images of the town go to a folder."""
    town = Town(
        given.seed,
        "hdl64e_lasers",
        given.count * STRETCH_FRAMES,
        interval=2.0,
        motion=False,
    )
    real = [
        town[i * STRETCH_FRAMES]
        for i in tqdm(range(given.count), desc="town", unit="scan")
    ]
    layouts = [layout_of(scan) for scan in real]
    real = with_images(real, town, folder) if needs_images(given.models) else real
    comparison = (
        Comparison(real, load_judge(), given.intervals) if given.distances else None
    )
    counts: dict[str, Any] = {
        "the town's own scans": layout_agreement(real, layouts, real)
    }
    distances: list[Measured] = []
    for i, text in enumerate(given.models):
        name, model = text.split("=", 1)
        model, _, steps = model.partition(":")
        kind, scans = generate(
            model, int(steps) if steps else None, given.guidance, real
        )
        counts[name] = (
            layout_agreement(scans, layouts, real) if kind == "layout" else None
        )
        if comparison is not None:
            distances.append(comparison.measure(name, scans))
        if i == 0 and given.picture:
            apart = np.unique(np.linspace(0, len(real) - 1, SHOWN).astype(int))
            draw(
                given.picture,
                *([some[k] for k in apart] for some in (scans, real, layouts)),
            )
    print(f"{given.count} layouts of the town of seed {given.seed}\n")
    print(
        "| scans | points of boxed classes in a box, % | boxes that 20 rays meet with 10 points, %",
        end=" ",
    )
    print(
        "| boxes with 20 points in the town's scan with 10 points, % | points | boxes | boxes |"
    )
    print(
        "|---|---:|---:|---:|---:|---:|---:|\n"
        + "\n".join(line(name, found) for name, found in counts.items())
    )
    if comparison is not None:
        print(f"\n{table(distances)}")
    if given.dump:
        given.dump.write_text(
            json.dumps(
                {name: found and found._asdict() for name, found in counts.items()},
                indent=1,
            )
        )


if __name__ == "__main__":
    main()
