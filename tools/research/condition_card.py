"""Does a model follow its condition? The figures and images of conditional models in
docs/research/conditions.md.

    python tools/research/condition_card.py NAME=MODEL[:STEPS] ... [--root ROOT] [--split val]
        [--count 64] [--picture OUT.png]

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

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import gallery
import numpy as np
from gallery import save
from model_card import (
    REFERENCE,
    SEED,
    Asked,
    Comparison,
    Measured,
    apart,
    needs_images,
    table,
    town,
    with_images,
)
from numpy.typing import NDArray
from PIL import Image
from tqdm import tqdm
from typer import run

from lidar_synth import Scan, Town, load_generator, open_scans
from lidar_synth.files.markdown import escape_markdown
from lidar_synth.geometry import Sensor
from lidar_synth.geometry.projection import project
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


def generate(asked: Asked, real: Sequence[Scan]) -> tuple[str, list[Scan]]:
    """The kind of condition, and one generated scan for the condition of each real scan."""
    generator = load_generator(asked.model)
    if generator.condition is None:
        raise SystemExit(f"{asked.model} is unconditional: see model_card.py")
    made = (
        generator.scans(SEED, [i], condition=scan, steps=asked.steps)[0]
        for i, scan in enumerate(tqdm(real, desc=asked.name, unit="scan"))
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
    rows = []
    for a, b in zip(apart(made, SHOWN), apart(real, SHOWN), strict=True):
        assert a.sensor is not None
        rows.append(
            [
                ("condition", seen(kind, b, a.sensor)),
                ("generated", render(a, "label", size=(900, 540))),
                ("scan of the condition", render(b, "label", size=(900, 540))),
            ]
        )
    save(path, gallery.draw(rows), 1500, 256)


def conditions(
    root: str | None, split: str | None, count: int, images: Path | None
) -> list[Scan]:
    """The scans of which the conditions are taken; images of the town go to a folder."""
    if root:
        return apart(open_scans(root, split=split), count)
    real = town(REFERENCE, count)
    source = Town(REFERENCE, scans=count * STRETCH_FRAMES, interval=1.0)
    return real if images is None else with_images(real, source, images)


def main(
    models: list[str],
    root: str | None = None,
    split: str | None = None,
    count: int = 64,
    intervals: int = 200,
    picture: Path | None = None,
) -> None:
    """Prints the tables; writes the picture, which is not to be published for real data."""
    judge = load_judge()
    every = [Asked.parse(text) for text in models]
    with TemporaryDirectory() as folder:
        images = Path(folder) if needs_images(every) else None
        real = conditions(root, split, count, images)
        comparison = Comparison(real, judge, intervals)
        sets: list[Measured] = []
        verdicts = []
        for asked in every:
            kind, scans = generate(asked, real)
            sets.append(comparison.measure(asked.name, scans))
            if len(sets) == 1:
                verdicts.append(verdict("the real scans", kind, real, real, judge))
            verdicts.append(verdict(asked.name, kind, scans, real, judge))
            if picture and len(sets) == 1:
                draw(picture, kind, scans, real)
    print(f"{len(real)} scans in each set\n\n{table(sets)}")
    print(
        "\n| scans | % | with its own condition | with another's |\n|---|---|---:|---:|"
    )
    print("\n".join(verdicts))


if __name__ == "__main__":
    run(main)
