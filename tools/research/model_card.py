"""The figures and images of docs/research/quality.md: how close generated scans are to scans of the
town.

    python tools/research/model_card.py NAME=MODEL[:STEPS[:WEAKER:SCALE:LOW:HIGH]] ...
        [--count 512] [--real A B] [--pictures OUT]

    python tools/research/model_card.py "student, 4 steps=town" \\
        "teacher, 50 steps=RUN/town_teacher.safetensors:50" \\
        "teacher, 4 steps=RUN/town_teacher.safetensors:4" --pictures docs/models

Every model generates scans from the same noise. They are compared with scans of a town that no
model was trained on (seed 1), on the grid of its sensor; a denser scan is projected to it. The
first column is a third town (seed 2): real against real, the lower bound. ``--real A B`` takes the
scans of two folders instead of the two towns. With STEPS = 0 a column has the third town's scans,
encoded and decoded by the model's autoencoder: the lower bound for its flow. With the checkpoint of
a WEAKER model the flow is autoguided from t = HIGH to LOW, as the teacher of a student is.

The measures are those that need no published weights: R2Flow's, LiDM's, the package's own of ranges
and classes, and those of the features of the town segmenter. 95 % intervals follow in brackets; the
Fréchet distance gets one from 256 scans on.

tools/research/condition_card.py is for conditional models.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from gallery import save, sheet
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor, nn
from tqdm import tqdm
from typer import run

from lidar_synth.datasets.classes import TRAIN_ID
from lidar_synth.errors import ConfigError
from lidar_synth.files.markdown import escape_markdown
from lidar_synth.formats import open_scans
from lidar_synth.generate.checkpoint import CODEC, load_checkpoint
from lidar_synth.generate.codec import Latent
from lidar_synth.generate.flow.guidance import autoguide
from lidar_synth.generate.loading import find_model, load_generator
from lidar_synth.geometry import SYNTHETIC, Scan, load_sensor
from lidar_synth.geometry.projection import project, unproject
from lidar_synth.lab.evaluate import Metric, Score, bootstrap
from lidar_synth.lab.evaluate.isolated import count_isolated, share_of_isolated
from lidar_synth.lab.evaluate.segmentation import (
    Judge,
    class_ious,
    load_judge,
    mean_iou,
)
from lidar_synth.lab.evaluate.statistics import Counts, Statistic
from lidar_synth.lab.town import STRETCH_FRAMES, Town
from lidar_synth.noise import uniform

REFERENCE = 1
OTHER = 2
"""Seeds of the two towns that generated scans are compared with."""
SEED = 1
"""Seed of the noise."""
CLASSES = (
    "road",
    "sidewalk",
    "terrain",
    "car",
    "building",
    "fence",
    "vegetation",
    "trunk",
    "pole",
)
BEND = "bend of walls, %"
SPAN = 8
"""Columns to either side over which the bend of a wall is measured."""
TILES = 16
"""Scans on a sheet."""


class Autoguided(nn.Module):
    """A flow that is autoguided by a weaker one."""

    def __init__(
        self,
        network: nn.Module,
        weaker: nn.Module,
        scale: float,
        low: float,
        high: float,
    ) -> None:
        super().__init__()
        self.network = network
        self.weaker = weaker
        self.how = (scale, (low, high))

    def forward(self, y: Tensor, t: Tensor, cond: Any = None) -> Tensor:
        """Velocities."""
        return autoguide(self.network, self.weaker, *self.how)(y, t, cond)


class Asked(NamedTuple):
    """A model of the command line.

    Args:
        name: the head of its column.
        model: a shipped model or a checkpoint.
        steps: of the flow; None = the model's own.
        guidance: WEAKER, SCALE, LOW and HIGH, if given.
    """

    name: str
    model: str
    steps: int | None
    guidance: list[str]

    @classmethod
    def parse(cls, text: str) -> "Asked":
        """NAME=MODEL[:STEPS[:WEAKER:SCALE:LOW:HIGH]]."""
        name, _, rest = text.partition("=")
        model, *more = rest.split(":")
        steps = int(more[0]) if any(more[:1]) else None
        return cls(name, model, steps, more[1:])


def generate(asked: Asked, count: int) -> list[Scan]:
    """Scans of one model, measured on the town's grid; all models get the same noise."""
    generator = load_generator(asked.model)
    if asked.guidance:
        weaker, *how = asked.guidance
        guided = Autoguided(
            generator.network, load_generator(weaker).network, *map(float, how)
        )
        generator = replace(generator, network=guided)
    sensor = load_sensor("town")
    indices = tqdm(range(count), desc=Path(asked.model).stem, unit="scan")
    made = (generator.scans(SEED, [i], steps=asked.steps)[0] for i in indices)
    return [replace(scan, sensor=sensor) for scan in made]


def open_codec(model: str) -> Latent:
    """The autoencoder of a checkpoint.

    Raises:
        ConfigError: on a checkpoint without an autoencoder.
    """
    checkpoint = load_checkpoint(find_model(model))
    if CODEC not in checkpoint.networks:
        raise ConfigError(
            f"{model} without an autoencoder",
            "the checkpoint of one, or of a latent model",
        )
    return Latent(checkpoint.networks[CODEC].eval(), checkpoint.header.tensors)


def resampled(model: str, scans: Sequence[Scan]) -> list[Scan]:
    """Scans after encoding and decoding: sampled from the distributions that a model's autoencoder
    predicts."""
    codec = open_codec(model)
    made = []
    for i, scan in enumerate(
        tqdm(scans, desc=f"{Path(model).stem}, autoencoder", unit="scan")
    ):
        image = project(scan, channels=["reflectance", "label"])
        noise = uniform(SEED, [i], (codec.draws, *image.sensor.shape), "cpu")
        x = codec.decode(codec.encode(codec.tensors.from_images([image])), noise)
        made.append(
            replace(
                unproject(codec.tensors.to_images(x, image.sensor)[0]), domain=SYNTHETIC
            )
        )
    return made


def town(seed: int, count: int) -> list[Scan]:
    """Scans of one town, each on a different street: neighbouring scans would show only three or
    four streets."""
    source = Town(seed, scans=count * STRETCH_FRAMES, interval=1.0)
    return [
        source[i * STRETCH_FRAMES]
        for i in tqdm(range(count), desc=f"town {seed}", unit="scan")
    ]


def needs_images(models: Sequence[Asked]) -> bool:
    """Whether one of the models is conditioned on camera images."""
    return any(load_generator(one.model).condition == "camera" for one in models)


def with_images(scans: Sequence[Scan], source: Town, folder: Path) -> list[Scan]:
    """The first scan of each street of a town, with the image taken with it, which goes to a
    folder."""
    found: list[Scan] = []
    for i, scan in enumerate(tqdm(scans, desc="images", unit="image")):
        path = folder / f"{i:06d}.png"
        Image.fromarray(source.image(i * STRETCH_FRAMES)).save(path)
        found.append(replace(scan, image_path=path))
    return found


class Measured(NamedTuple):
    """The figures of one set of scans.

    Args:
        name: the head of its column.
        scores: distances from the reference, and the mIoU between labels and the segmenter's
            prediction, %.
        classes: {class: its IoU, %, and the bend of walls, %}; NaN without labels.
        isolated: (20,) share of isolated returns by class, %.
    """

    name: str
    scores: list[Score]
    classes: dict[str, float]
    isolated: NDArray[np.float64]


def apart(scans: Sequence[Any], count: int) -> list[Any]:
    """At most ``count`` of the scans, spread evenly."""
    indices = np.unique(np.linspace(0, len(scans) - 1, count).astype(int))
    return [scans[int(i)] for i in tqdm(indices, unit="scan", leave=False)]


def opened(root: Path, count: int) -> list[Scan]:
    """At most ``count`` scans of a folder, spread over it, on the town's grid."""
    sensor = load_sensor("town")
    return [replace(scan, sensor=sensor) for scan in apart(open_scans(root), count)]


class Comparison:
    """Scans that sets of scans are compared with; they are described once.

    Args:
        scans: the reference.
        judge: the town segmenter.
        replicates: resamples for 95 % intervals; 0 = none.
    """

    def __init__(
        self, scans: Sequence[Scan], judge: Judge, replicates: int = 0
    ) -> None:
        self._judge = judge
        self._replicates = replicates
        self._count = len(scans)
        own = {"the town segmenter": judge.features}
        more = (Metric(name, replicates=replicates) for name in ("lidm", "general"))
        self._metrics = [
            Metric("town", own, replicates=replicates, extended=True),
            *more,
        ]
        for metric in self._metrics:
            metric.update(
                tqdm(scans, desc=f"reference, {metric.protocol.name}", unit="scan"),
                real=True,
            )

    def measure(self, name: str, scans: Sequence[Scan]) -> Measured:
        """Compare a set of scans with the reference."""
        scores: list[Score] = []
        for metric in self._metrics:
            metric.reset(real=False)
            metric.update(
                tqdm(scans, desc=f"{name}, {metric.protocol.name}", unit="scan"),
                real=False,
            )
            # LiDM's distances of features need weights that do not belong to the card.
            own = metric.protocol.name == "town"
            scores += [
                s for s in metric.scores() if own or not s.metric.startswith("Frechet")
            ]
        columns = (*CLASSES, BEND)
        isolated = 100 * share_of_isolated(np.sum(list(map(count_isolated, scans)), 0))
        if any(scan.label is None for scan in scans):
            nothing = dict.fromkeys(columns, float("nan"))
            return Measured(name, scores, nothing, isolated)
        tables = np.stack([self._judge.agreement([scan]) for scan in scans])
        ious = 100 * class_ious(tables.sum(0))
        values = [ious[TRAIN_ID[one]] for one in CLASSES] + [100 * bend(scans)]
        agreement = _agreement(tables, self._count, self._replicates)
        classes = dict(zip(columns, values, strict=True))
        return Measured(name, [*scores, agreement], classes, isolated)


def _agreement(tables: NDArray[np.int64], real: int, replicates: int) -> Score:
    """The mIoU of (N, 19, 19) confusions, one per scan."""

    def at(a: Counts, b: Counts) -> NDArray[np.float64]:
        return np.array(
            [100 * mean_iou(np.tensordot(counts, tables, 1)) for counts in b]
        )

    statistic = Statistic(at, (real, len(tables)))
    interval = (
        bootstrap(statistic, replicates, smallest=0, largest=100)
        if replicates
        else None
    )
    low, high, corrected = interval or (None, None, None)
    return Score(
        "mIoU with the town segmenter, %",
        statistic.value,
        "town",
        real,
        len(tables),
        low=low,
        high=high,
        corrected=corrected,
    )


def table(sets: Sequence[Measured]) -> str:
    """Figures as rows, sets as columns; then IoU between the labels and the segmenter's prediction
    by class, and the bend of walls; then isolated returns by class."""
    names = [escape_markdown(one.name) for one in sets]
    scores = [{f"{s.metric} ({s.protocol})": s for s in one.scores} for one in sets]
    lines = head("figure", names)
    for title in dict.fromkeys(title for own in scores for title in own):
        lines.append(
            row(title, [own[title].shown() if title in own else "" for own in scores])
        )
    lines += ["", *head("IoU with the segmenter, %", (*CLASSES, BEND))]
    for name, one in zip(names, sets, strict=True):
        values = [f"{one.classes[kind]:.0f}" for kind in CLASSES]
        lines.append(row(name, [*values, f"{one.classes[BEND]:.1f}"]))
    lines += ["", *head("isolated returns, %", CLASSES)]
    for name, one in zip(names, sets, strict=True):
        shares = [f"{one.isolated[TRAIN_ID[kind]]:.1f}" for kind in CLASSES]
        lines.append(row(name, shares))
    return "\n".join(lines)


def bend(scans: Sequence[Scan]) -> float:
    """The bend of walls: median of |q(j - 8) - 2 q(j) + q(j + 8)| / q(j) of the inverse ranges q of
    rows, where all cells from j - 8 to j + 8 are a building's. A plane has 0.0024 on 1024
    columns."""
    found = []
    for scan in scans:
        image = project(scan, scan.sensor, ["label"])
        wall = image.mask & (image.channels["label"] == TRAIN_ID["building"])
        near = np.divide(1, image.range, where=wall, out=np.zeros_like(image.range))
        shifted = [np.roll(wall, k, 1) for k in range(-SPAN, SPAN + 1)]
        inside = np.logical_and.reduce(shifted)
        second = np.roll(near, SPAN, 1) - 2 * near + np.roll(near, -SPAN, 1)
        found.append(np.abs(second[inside]) / near[inside])
    return float(np.median(np.concatenate(found)))


def head(name: str, columns: Sequence[str]) -> list[str]:
    """The first two lines of a table in Markdown."""
    return [row(name, columns), f"|---|{'---:|' * len(columns)}"]


def row(name: str, cells: Sequence[str]) -> str:
    """A row of a table in Markdown."""
    return f"| {name} | {' | '.join(cells)} |"


def draw(folder: Path, name: str, made: Sequence[Scan], real: Sequence[Scan]) -> None:
    """Write sheets of generated scans and of the town."""
    sheets = {
        "generated": sheet(made[:TILES], f"{name}: {TILES} scans, not selected"),
        "town": sheet(apart(real, TILES), f"{TILES} scans of the town"),
    }
    for stem, pixels in sheets.items():
        save(folder / f"{stem}.png", pixels, 1500, 256)


def main(
    models: list[str],
    count: int = 512,
    real: tuple[Path, Path] | None = None,
    intervals: int = 200,
    pictures: Path | None = None,
) -> None:
    """Prints the tables; writes the pictures."""
    if real:
        reference, other = (opened(root, count) for root in real)
    else:
        reference, other = (town(seed, count) for seed in (REFERENCE, OTHER))
    comparison = Comparison(reference, load_judge(), intervals)
    sets: list[Measured] = []
    for asked in map(Asked.parse, models):
        encoded = asked.steps == 0
        scans = resampled(asked.model, other) if encoded else generate(asked, count)
        if pictures and not sets:
            draw(pictures, asked.name, scans, reference)
        sets.append(comparison.measure(asked.name, scans))
    bound = comparison.measure("real against real (lower bound)", other)
    print(f"{count} scans in each set, {len(reference)} of the reference\n")
    print(table([bound, *sets]))


if __name__ == "__main__":
    run(main)
