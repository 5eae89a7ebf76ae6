"""The figures and images of docs/research/quality.md: how close generated scans are to scans of the
town.

    python tools/research/model_card.py NAME=MODEL[:STEPS[:WEAKER:SCALE:LOW:HIGH]] ... [--count 512] [--real A B]
        [--pictures OUT]

    python tools/research/model_card.py "student, 4 steps=town" "teacher, 50 steps=RUN/town_teacher.safetensors:50" \\
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

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor, nn
from tqdm import tqdm

from lidar_synth.datasets.classes import TRAIN_ID
from lidar_synth.errors import ConfigError
from lidar_synth.files.markdown import escape_markdown
from lidar_synth.formats import open_scans
from lidar_synth.generate.checkpoint import CODEC, load_checkpoint
from lidar_synth.generate.codec import Latent
from lidar_synth.generate.flow.path import autoguide
from lidar_synth.generate.loading import find_model, load_generator
from lidar_synth.geometry.projection import project, unproject
from lidar_synth.geometry.scan import SYNTHETIC, Scan
from lidar_synth.geometry.sensor import load_sensor
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
from lidar_synth.viz import write_view

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


def generate(
    model: str, steps: int | None, count: int, weaker: str = "", *how: str
) -> list[Scan]:
    """Scans of one model, measured on the town's grid; all models get the same noise."""
    generator = load_generator(model)
    if weaker:
        guided = Autoguided(
            generator.network, load_generator(weaker).network, *map(float, how)
        )
        generator = replace(generator, network=guided)
    indices = tqdm(range(count), desc=Path(model).stem, unit="scan")
    return [
        replace(generator.scans(SEED, [i], steps=steps)[0], sensor=load_sensor("town"))
        for i in indices
    ]


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


def needs_images(models: Sequence[str]) -> bool:
    """Whether one of the models NAME=MODEL[:STEPS] is conditioned on camera images."""
    return any(
        load_generator(text.split("=", 1)[1].partition(":")[0]).condition == "camera"
        for text in models
    )


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


def opened(root: Path, count: int) -> list[Scan]:
    """At most ``count`` scans of a folder, spread over it, on the town's grid."""
    source = open_scans(root)
    indices = np.unique(np.linspace(0, len(source) - 1, count).astype(int))
    return [
        replace(source[int(i)], sensor=load_sensor("town"))
        for i in tqdm(indices, desc=root.name, unit="scan")
    ]


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
    low, high = interval or (None, None)
    return Score(
        "mIoU with the town segmenter, %",
        statistic.value,
        "town",
        real,
        len(tables),
        low=low,
        high=high,
    )


def table(sets: Sequence[Measured]) -> str:
    """Figures as rows, sets as columns; then IoU between the labels and the segmenter's prediction
    by class, and the bend of walls; then isolated returns by class."""
    titles = list(
        dict.fromkeys(f"{s.metric} ({s.protocol})" for one in sets for s in one.scores)
    )
    lines = [
        f"| figure | {' | '.join(escape_markdown(one.name) for one in sets)} |",
        f"|---|{'---:|' * len(sets)}",
    ]
    for title in titles:
        found = [
            next((s for s in one.scores if f"{s.metric} ({s.protocol})" == title), None)
            for one in sets
        ]
        lines.append(
            f"| {title} | {' | '.join(_shown(score) if score else '' for score in found)} |"
        )
    columns = (*CLASSES, BEND)
    lines += [
        "",
        f"| IoU with the segmenter, % | {' | '.join(columns)} |",
        f"|---|{'---:|' * len(columns)}",
    ]
    for one in sets:
        values = [
            f"{one.classes[c]:.1f}" if c == BEND else f"{one.classes[c]:.0f}"
            for c in columns
        ]
        lines.append(f"| {escape_markdown(one.name)} | {' | '.join(values)} |")
    lines += [
        "",
        f"| isolated returns, % | {' | '.join(CLASSES)} |",
        f"|---|{'---:|' * len(CLASSES)}",
    ]
    for one in sets:
        values = [f"{one.isolated[TRAIN_ID[c]]:.1f}" for c in CLASSES]
        lines.append(f"| {escape_markdown(one.name)} | {' | '.join(values)} |")
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
        inside = np.logical_and.reduce(
            [np.roll(wall, k, 1) for k in range(-SPAN, SPAN + 1)]
        )
        second = np.roll(near, SPAN, 1) - 2 * near + np.roll(near, -SPAN, 1)
        found.append(np.abs(second[inside]) / near[inside])
    return float(np.median(np.concatenate(found)))


def _shown(score: Score) -> str:
    """The value with its interval, where it has one."""
    return f"{score.value:.4g}" + (
        "" if score.low is None else f" [{score.low:.4g}, {score.high:.4g}]"
    )


def picture(path: Path, scans: Sequence[Scan], title: str) -> None:
    """Write a sheet of scans as a PNG with few colours, small enough for a repository."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_view(path, list(scans), title=title)
    shrink(path)


def shrink(path: Path) -> None:
    """Reduce the pixels and colours of a PNG."""
    image = Image.open(path).convert("RGB")
    width = 1500
    image = image.resize(
        (width, round(image.height * width / image.width)), Image.Resampling.LANCZOS
    )
    # Few cells are cars or poles: a palette by number of pixels would lose their colours, a palette
    # by coverage alone those of the background.
    image.quantize(
        256, Image.Quantize.MAXCOVERAGE, kmeans=1, dither=Image.Dither.NONE
    ).save(path, optimize=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "models", nargs="+", metavar="NAME=MODEL[:STEPS[:WEAKER:SCALE:LOW:HIGH]]"
    )
    parser.add_argument("--count", type=int, default=512, help="scans in each row")
    parser.add_argument(
        "--real",
        type=Path,
        nargs=2,
        metavar=("A", "B"),
        help="folders of scans instead of two towns",
    )
    parser.add_argument(
        "--intervals",
        type=int,
        default=200,
        help="resamples for 95 %% intervals; 0 = none",
    )
    parser.add_argument(
        "--pictures",
        type=Path,
        help="folder for sheets of the first model and of the town",
    )
    given = parser.parse_args()

    @cache
    def real(which: int) -> list[Scan]:
        if given.real:
            return opened(given.real[which], given.count)
        return town((REFERENCE, OTHER)[which], given.count)

    def add(name: str, scans: Sequence[Scan]) -> None:
        sets.append(comparison.measure(name, scans))
        print(
            "\n".join([name, *map(str, sets[-1].scores)]), file=sys.stderr, flush=True
        )

    comparison = Comparison(real(0), load_judge(), given.intervals)
    sets: list[Measured] = []
    for i, text in enumerate(given.models):
        name, spec = text.split("=", 1)
        model, steps, *guidance = spec.split(":") if ":" in spec else (spec, "")
        if steps == "0":
            scans = resampled(model, real(1))
        else:
            scans = generate(
                model, int(steps) if steps else None, given.count, *guidance
            )
        add(name, scans)
        if i == 0 and given.pictures:
            apart = np.linspace(0, len(real(0)) - 1, TILES).astype(int)
            picture(
                given.pictures / "generated.png",
                scans[:TILES],
                f"{name}: {TILES} scans, not selected",
            )
            picture(
                given.pictures / "town.png",
                [real(0)[k] for k in apart],
                f"{TILES} scans of the town",
            )
    add("real against real (lower bound)", real(1))
    print(
        f"{given.count} scans in each set, {len(real(0))} of the "
        f"reference\n\n{table([sets[-1], *sets[:-1]])}"
    )


if __name__ == "__main__":
    main()
