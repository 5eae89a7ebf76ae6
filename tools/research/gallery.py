"""Make the pictures of docs/gallery.md: scans of the shipped models beside scans of the town.

    python tools/research/gallery.py [NAME ...] [--out docs/gallery]

    pairs     generated scans on the left, scans of the town on the right
    channels  all channels of one generated scan
    map       scans generated from one label map
    camera    scans generated from camera images
    layout    scans generated from layouts, with boxes
    paste     a generated scan before and after the town's objects replaced its own
    sensors   one street as three sensors see it
    weather   a scan in clear air, and in weather of three severities
    changed   a recorded sweep of PandaSet, and what the demo makes of it
    steps     the same sweep after each augmentation and edit

All scans are the first ones of their seed: none is selected. Each picture takes less than a minute
on one core.
"""

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure, SubFigure
from numpy.typing import NDArray
from PIL import Image
from typer import Argument, BadParameter, run

from lidar_synth import Compose, Scan, load_generator, project, sample_scans
from lidar_synth.lab.town import STRETCH_FRAMES, Town
from lidar_synth.labels import ObjectBank, edit, make_policy
from lidar_synth.labels.compose import MIXES, MOVES
from lidar_synth.labels.objects import objects_of
from lidar_synth.viz import Orbit, picture, render, write_view
from lidar_synth.weather import CORRUPTIONS, SEVERITIES

sys.path.append(str(Path(__file__).parents[1]))  # the other tools
import demo

Picture = NDArray[np.uint8]
"""(height, width, 3) uint8."""

AHEAD = 58
"""Box of the car ahead in the first recorded sweep."""
FLIPPING = 3
"""Seed of random numbers with which ``flip_x`` and ``flip_y`` flip."""
UNSEEN = 1
"""Seed of a town that no model was trained on."""
NEAR = Orbit(
    azimuth=160, elevation=22, distance=27, field=45, target=(5, 0, -1)
).camera()
"""A camera from which cars and poles are distinguishable."""
SIZE = (760, 400)
"""Width and height of one scan, in pixels."""
TITLE = 0.36
"""Height of a title, in inches."""
WIDTH = 1200
"""Width of a picture, in pixels."""


def street(index: int, **options: object) -> Scan:
    """The first scan of a street of the unseen town."""
    town = Town(UNSEEN, scans=(index + 1) * STRETCH_FRAMES, **options)  # type: ignore[arg-type]
    return town[index * STRETCH_FRAMES]


def near(scan: Scan, boxes: bool = False) -> Picture:
    """A scan seen by ``NEAR``, coloured by label."""
    return render(scan, "label", camera=NEAR, size=SIZE, boxes=boxes)


def pairs() -> list[list[tuple[str, Picture]]]:
    """Generated scans and the town's."""
    made = load_generator("town").scans(0, range(3))
    return [
        [
            (f"generated, 4 steps: town/0/{i}", near(scan)),
            (
                f"the town, street {i}",
                near(street(i, sensor="hdl64e_lasers", motion=False)),
            ),
        ]
        for i, scan in enumerate(made)
    ]


def from_map() -> list[list[tuple[str, Picture]]]:
    """The map of one scan, two scans generated from it, and the scan itself."""
    scan = street(0)
    generator = load_generator("town-semantic")
    labels = picture(project(scan, generator.sensor, ["label"]), "label")
    made = generator.scans(0, range(3), condition=scan)
    return [
        [("condition: a label map", np.repeat(labels, 4, axis=0))],
        [("the town's scan with this map", near(scan)), ("generated", near(made[0]))],
        [
            ("generated, other noise", near(made[1])),
            ("generated, other noise", near(made[2])),
        ],
    ]


def from_camera() -> list[list[tuple[str, Picture]]]:
    """Images of the camera, the scans generated from them, and the scans taken with them."""
    generator = load_generator("town-camera")
    rows = []
    for i in range(2):
        town = Town(UNSEEN, scans=(i + 1) * STRETCH_FRAMES)
        image = town.image(i * STRETCH_FRAMES)
        # As its encoder takes it.
        small = Image.fromarray(image).resize((320, 96), Image.Resampling.BICUBIC)
        [made] = generator.scans(0, [i], condition=np.array(small).transpose(2, 0, 1))
        rows += [
            [("condition: a camera image", image)],
            [
                ("generated", near(made)),
                (
                    "the town's scan taken with the image",
                    near(town[i * STRETCH_FRAMES]),
                ),
            ],
        ]
    return rows


def from_layout() -> list[list[tuple[str, Picture]]]:
    """Scans with boxes, and the scans generated from their layouts."""
    generator = load_generator("town-layout")
    rows = []
    for i in range(2):
        scan = street(i, sensor="hdl64e_lasers")
        [made] = generator.scans(0, [i], condition=scan)
        rows += [
            [
                ("generated from boxes, ground and outlines", near(made, boxes=True)),
                ("the town's scan with this layout", near(scan, boxes=True)),
            ]
        ]
    return rows


def pasted() -> list[list[tuple[str, Picture]]]:
    """A generated scan, and the same with objects of the town in place of its own (the label policy
    ``paste``)."""
    generator = load_generator("town")
    scans = Town(0, "hdl64e_lasers", 5 * STRETCH_FRAMES, motion=False)
    bank = ObjectBank.from_scans(
        [scans[i] for i in range(0, len(scans), STRETCH_FRAMES // 2)]
    )
    policy = make_policy(
        "paste", fields=generator.fields, bank=bank, count=12, clear=True
    )
    [scan] = generator.scans(0, [0])
    mixed = policy(scan, np.random.default_rng(0))
    return [
        [
            ("generated", near(scan)),
            (
                "its objects replaced by pasted ones, with boxes",
                near(mixed, boxes=True),
            ),
        ]
    ]


def sensors() -> list[list[tuple[str, Picture]]]:
    """One street as three sensors see it."""
    names = {
        "town": "HDL-64E",
        "os1_128": "Ouster OS1-128",
        "hdl32e_nuscenes": "HDL-32E",
    }
    return [
        [
            (f"{title}: {name}", near(street(1, sensor=name)))
            for name, title in names.items()
        ]
    ]


def weather() -> list[list[tuple[str, Picture]]]:
    """A scan in clear air, and in weather of three severities."""
    scan = street(0, sensor="hdl64e_lasers", motion=False)
    rows = []
    for name in ("fog", "snow", "wet_ground"):
        row = [("clear", near(scan))]
        for severity in SEVERITIES:
            changed = CORRUPTIONS[name].at(severity)(scan, np.random.default_rng(0))
            row.append((f"{name.replace('_', ' ')}, {severity}", near(changed)))
        rows.append(row)
    return rows


def changed() -> list[list[tuple[str, Picture]]]:
    """A recorded sweep, and what weather, another sensor and an edit make of it."""
    scans = demo.change(sample_scans()[0])
    views = [(scan.id, near(scan)) for scan in scans]
    return [views[:3], views[3:]]


def steps() -> list[list[tuple[str, Picture]]]:
    """A recorded sweep after each augmentation and edit. Of ``drop_reflectance`` labels show
    nothing."""
    real = sample_scans()
    scan = real[0]
    assert scan.boxes is not None
    x, y, *_, yaw = scan.boxes.values[AHEAD].tolist()
    views = [("as recorded", near(scan))]
    named: dict[str, dict[str, Any]] = {name: {} for name in (*MOVES, *MIXES)}
    named["paste"] = {"count": 12}
    named |= {name: {"severity": "moderate"} for name in CORRUPTIONS}
    del named["drop_reflectance"], named["polarmix_or_lasermix"]
    for name, arguments in named.items():
        step = Compose([{name: arguments}]).bind(real, frozenset(real.fields))
        title = name.replace("_", " ")
        views.append((title, near(step(scan, np.random.default_rng(FLIPPING)))))
    edits = {
        "with its boxes": scan,
        "remove": edit.remove(scan, AHEAD),
        "move": edit.move(scan, AHEAD, (x, y + 4, yaw)),
        "insert": edit.insert(scan, objects_of(scan)[AHEAD], (x - 5, y, yaw)),
    }
    views += [(name, near(made, boxes=True)) for name, made in edits.items()]
    return [views[first : first + 3] for first in range(0, len(views), 3)]


PICTURES: dict[str, Callable[[], list[list[tuple[str, Picture]]]]] = {
    "pairs": pairs,
    "map": from_map,
    "camera": from_camera,
    "layout": from_layout,
    "paste": pasted,
    "sensors": sensors,
    "weather": weather,
    "changed": changed,
    "steps": steps,
}
"""Rows of titled images."""


def draw(rows: Sequence[Sequence[tuple[str, Picture]]]) -> Picture:
    """Rows of images with their titles, all rows of the same width."""
    heights = [12 / sum(map(shape, row)) + TITLE for row in rows]
    figure = Figure(figsize=(12, sum(heights)), facecolor="#101218", dpi=150)
    FigureCanvasAgg(figure)
    parts = np.atleast_1d(figure.subfigures(len(rows), 1, height_ratios=heights))
    for part, row, height in zip(parts, rows, heights, strict=True):
        draw_row(part, row, 1 - TITLE / height)
    figure.canvas.draw()
    pixels: Picture = np.asarray(figure.canvas.buffer_rgba())[..., :3]  # type: ignore[attr-defined]
    return pixels


def channels() -> Picture:
    """The sheet of a generated scan."""
    return sheet(load_generator("town").scans(0, [0]))


def shape(one: tuple[str, Picture]) -> float:
    """Width over height of a titled image."""
    height, width, _ = one[1].shape
    return width / height


def sheet(scans: Sequence[Scan], title: str = "") -> Picture:
    """What ``lidar-synth view`` shows of scans."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "scans.png"
        write_view(path, list(scans), title=title)
        return np.asarray(Image.open(path).convert("RGB"))


def save(path: Path, pixels: Picture, width: int = WIDTH, colours: int = 48) -> None:
    """Write a PNG with few colours, small enough for a repository."""
    image = Image.fromarray(pixels)
    size = (width, round(image.height * width / image.width))
    image = image.resize(size, Image.Resampling.LANCZOS)
    # Few pixels are cars or poles: a palette by number of pixels would lose their colours, one by
    # coverage alone those of the background.
    image = image.quantize(
        colours, Image.Quantize.MAXCOVERAGE, kmeans=1, dither=Image.Dither.NONE
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    image.save(path, optimize=True)


def draw_row(part: SubFigure, row: Sequence[tuple[str, Picture]], top: float) -> None:
    """Draw titled images side by side, up to a share of the height."""
    part.set_facecolor("#101218")
    widths = [shape(one) for one in row]
    grid = part.subplots(1, len(row), squeeze=False, width_ratios=widths)
    part.subplots_adjust(left=0.003, right=0.997, bottom=0, top=top, wspace=0.01)
    for axes, (name, image) in zip(grid[0], row, strict=True):
        axes.imshow(image, interpolation="lanczos")
        axes.set_title(name, color="#9aa0ad", fontsize=14, loc="left", pad=4)
        axes.set_axis_off()


def main(
    names: Annotated[list[str] | None, Argument()] = None,
    out: Path = Path("docs/gallery"),
) -> None:
    """Draws the pictures with these names, by default all."""
    known = ["channels", *PICTURES]
    if unknown := set(names or ()) - set(known):
        raise BadParameter(f"{', '.join(unknown)}; expected: {', '.join(known)}")
    for name in names or known:
        pixels = channels() if name == "channels" else draw(PICTURES[name]())
        save(out / f"{name}.png", pixels)
        print(out / f"{name}.png")


if __name__ == "__main__":
    run(main)
