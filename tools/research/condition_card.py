"""Does a model follow its condition? The figures and images of conditional models in
docs/research/conditions.md.

    python tools/research/condition_card.py NAME=MODEL[:STEPS] ... [--root ROOT] [--split val] [--count 64]
        [--picture OUT.png]

    python tools/research/condition_card.py "student, 4 steps=town-semantic" \\
        "teacher, 50 steps=RUN/teacher.safetensors:50"

Every model gets the same noise and the conditions of the same real scans, from an unseen town or
from ROOT. The first table measures how close the generated scans are as a set. The second one
measures how well each agrees with the scan of its own condition, and with another scan, half the
set away:

    semantic   mIoU between the label map and the segmenter's prediction on the generated scan
    camera     intersection over union of the occupied bird's-eye cells (1 m) in the camera's view,
               up to 40 m away; a cell is occupied if it has a return above the ground
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from model_card import (
    REFERENCE,
    SEED,
    Comparison,
    Measured,
    needs_images,
    shrink,
    table,
    town,
    with_images,
)
from numpy.typing import NDArray
from PIL import Image
from tqdm import tqdm

from lidar_synth import Scan, Town, load_generator, open_scans
from lidar_synth.files.markdown import escape_markdown
from lidar_synth.geometry.projection import project
from lidar_synth.geometry.sensor import Sensor
from lidar_synth.lab.evaluate.conditions import AGREEMENTS
from lidar_synth.lab.evaluate.segmentation import Judge, load_judge
from lidar_synth.lab.town import STRETCH_FRAMES
from lidar_synth.viz import picture, render

SHOWN = 8
"""Examples in the picture."""


def verdict(
    name: str, kind: str, scans: Sequence[Scan], real: Sequence[Scan], judge: Judge
) -> str:
    """A line of the second table: the agreement with the own condition, and with another one."""
    measure, agreement = AGREEMENTS[kind]
    other = [*real[len(real) // 2 :], *real[: len(real) // 2]]
    values = [f"{100 * agreement(scans, some, judge):.1f}" for some in (real, other)]
    return f"| {escape_markdown(name)} | {measure} | {' | '.join(values)} |"


def generate(
    model: str, steps: int | None, real: Sequence[Scan]
) -> tuple[str, list[Scan]]:
    """The kind of condition, and one generated scan for the condition of each real scan."""
    generator = load_generator(model)
    if generator.condition is None:
        raise SystemExit(f"{model} is unconditional: see tools/research/model_card.py")
    made = (
        generator.scans(SEED, [i], condition=scan, steps=steps)[0]
        for i, scan in enumerate(tqdm(real, desc=Path(model).stem, unit="scan"))
    )
    return generator.condition, list(made)


def seen(kind: str, scan: Scan, sensor: Sensor) -> NDArray[np.uint8]:
    """The condition of a scan, as an image."""
    if kind == "camera":
        assert scan.image_path is not None
        return np.asarray(Image.open(scan.image_path).convert("RGB").resize((704, 188)))
    shown = picture(project(scan, sensor, ["label"]), "label")
    return np.repeat(shown, 4, axis=0)  # the map has only 64 rows


def draw(path: Path, kind: str, made: Sequence[Scan], real: Sequence[Scan]) -> None:
    """Write conditions, generated scans and the scans of the conditions side by side."""
    figure = Figure(
        figsize=(15, 3.05 * len(made)), facecolor="#1e1014", layout="constrained"
    )
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(made), 3, squeeze=False, width_ratios=[1.25, 1, 1])
    for axes, a, b in zip(grid, made, real, strict=True):
        assert a.sensor is not None
        images = (
            seen(kind, b, a.sensor),
            render(a, "label", size=(900, 540)),
            render(b, "label", size=(900, 540)),
        )
        for axis, image, title in zip(
            axes,
            images,
            ("condition", "generated", "scan of the condition"),
            strict=True,
        ):
            axis.imshow(
                image,
                aspect="equal" if kind == "camera" or title != "condition" else "auto",
            )
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
    parser.add_argument(
        "--root", help="a dataset with labels or images [default: a town]"
    )
    parser.add_argument("--split", help="split of ROOT")
    parser.add_argument("--count", type=int, default=64, help="scans in each row")
    parser.add_argument(
        "--intervals",
        type=int,
        default=200,
        help="resamples for 95 %% intervals; 0 = none",
    )
    parser.add_argument(
        "--picture",
        type=Path,
        help="PNG of the first model's scans; do not publish it for real data",
    )
    given = parser.parse_args()
    with TemporaryDirectory() as folder:
        report(given, Path(folder))


def report(given: argparse.Namespace, folder: Path) -> None:
    """Print the tables; images of the town go to a folder."""
    judge = load_judge()
    if given.root:
        source = open_scans(given.root, split=given.split)
        chosen = np.unique(np.linspace(0, len(source) - 1, given.count).astype(int))
        real = [source[int(i)] for i in tqdm(chosen, desc=given.root, unit="scan")]
    else:
        real = town(REFERENCE, given.count)
        if needs_images(given.models):
            real = with_images(
                real,
                Town(REFERENCE, scans=given.count * STRETCH_FRAMES, interval=1.0),
                folder,
            )
    comparison = Comparison(real, judge, given.intervals)
    sets: list[Measured] = []
    verdicts = []
    for i, text in enumerate(given.models):
        name, model = text.split("=", 1)
        model, _, steps = model.partition(":")
        kind, scans = generate(model, int(steps) if steps else None, real)
        sets.append(comparison.measure(name, scans))
        if i == 0:
            verdicts.append(verdict("the real scans", kind, real, real, judge))
        verdicts.append(verdict(name, kind, scans, real, judge))
        if i == 0 and given.picture:
            apart = np.unique(np.linspace(0, len(real) - 1, SHOWN).astype(int))
            draw(
                given.picture, kind, [scans[k] for k in apart], [real[k] for k in apart]
            )
    print(f"{len(real)} scans in each set\n\n{table(sets)}")
    print(
        "\n| scans | % | with its own condition | with another's |\n|---|---|---:|---:|\n"
        + "\n".join(verdicts)
    )


if __name__ == "__main__":
    main()
