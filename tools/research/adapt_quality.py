"""How good an adapted model is on scans that it has not seen, beside the model that it was adapted
from.

    python tools/research/adapt_quality.py pandaset FRAMES OUT
    lidar-synth adapt town --scans OUT/adapt --out mine.safetensors
    python tools/research/adapt_quality.py measure mine.safetensors --train OUT/adapt
        --test OUT/test [--before town] [--judge FOLDER] [--count 60]

FRAMES is a folder of Pandar64 scans from PandaSet as NN.npz (points, reflectance 0..255, ring,
label) in the sensor's frame; the first command writes frames 00 to 30 to OUT/adapt and frames from
60 on to OUT/test. The last command prints, for both models:

    returns, labels       of encoded and decoded test scans, share of the cells whose return is
                          right, and share of the returns with a label whose label is the same; IoU
                          by class
    Frechet distance      of generated scans to the test scans, in the features of the shipped
                          segmenter and, with --judge, of an archive of lidar-bonnetal; beside it
                          that of the training scans
    nearest               median distance of generated scans to the nearest training scan, beside
    those among real scans
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm
from typer import Option, Typer

from lidar_synth import load_generator, load_sensor, open_scans
from lidar_synth.datasets.classes import IGNORE, NAMES, PANDASET
from lidar_synth.files.parsing import read_arrays
from lidar_synth.formats import WRITERS
from lidar_synth.generate.checkpoint import CODEC, load_checkpoint
from lidar_synth.generate.codec import Latent
from lidar_synth.generate.loading import find_model
from lidar_synth.geometry.projection import project
from lidar_synth.geometry.scan import RangeImage, Scan
from lidar_synth.geometry.sensor import Sensor
from lidar_synth.lab.evaluate.distances import frechet_distance
from lidar_synth.lab.evaluate.neighbours import nearest_training
from lidar_synth.lab.evaluate.segmentation import class_ious, load_judge
from lidar_synth.lab.evaluate.street_judge import load_archive
from lidar_synth.lab.train.adaptation.regrid import regrid
from lidar_synth.noise import uniform

LAST_LEARNT = 30
FIRST_TESTED = 60
SEED = 1
"""Seed of the noise."""

Features = Callable[[Sequence[Scan]], NDArray[np.floating]]


def pandaset(frames: Path, out: Path) -> None:
    """Write the frames of PandaSet to adapt to, and those to test on, as the package's scans."""
    sensor = load_sensor("pandar64")
    writers = {part: WRITERS["npz"](out / part) for part in ("adapt", "test")}
    for path in sorted(frames.glob("[0-9][0-9].npz")):
        number = int(path.stem)
        if LAST_LEARNT < number < FIRST_TESTED:
            continue
        a = read_arrays(path, ("points", "reflectance", "ring", "label"))
        scan = Scan(
            a["points"],
            a["reflectance"].astype(np.float32) / 255,
            sensor,
            PANDASET.decode(a["label"], str(path)),
            ring=a["ring"].astype(np.int16),
        )
        writers["adapt" if number <= LAST_LEARNT else "test"].write(scan, number)


def measure(
    checkpoint: Path,
    train: Annotated[Path, Option()],
    test: Annotated[Path, Option()],
    before: str = "town",
    judge: Path | None = None,
    columns: int | None = None,
    count: int = 60,
) -> None:
    """Print the figures of an adapted checkpoint; columns are those at which the judge looks."""
    learnt = list(open_scans(train))
    unseen = list(open_scans(test))
    models = {"before": before, "adapted": str(checkpoint)}
    print_autoencoders(models, load_checkpoint(checkpoint).header.sensor, unseen)
    generated = {name: generate(model, count) for name, model in models.items()}
    extractors: dict[str, Features] = {"the shipped segmenter": load_judge().features}
    if judge is not None:
        extractors["the archive"] = load_archive(judge, columns).features
    for name, extractor in extractors.items():
        features_table(name, extractor, learnt, unseen, generated)


def generate(model: str, count: int) -> list[Scan]:
    """Scans of a model, from the same noise for all models."""
    generator = load_generator(model)
    return [
        generator.scans(SEED, [i])[0]
        for i in tqdm(range(count), desc=Path(model).stem, unit="scan")
    ]


def print_autoencoders(
    models: dict[str, str], sensor: Sensor, scans: Sequence[Scan]
) -> None:
    """Print the tables of encoded and decoded scans."""
    print(
        "| model | returns right, % | labels right, % | range within 5 cm, % | mean error of the "
        "range, m |\n|---|---:|---:|---:|---:|"
    )
    tables = {}
    for name, model in models.items():
        right, tables[name] = autoencoder_figures(model, sensor, scans)
        shares = " | ".join(f"{100 * share:.1f}" for share in right[:3])
        print(f"| {name} | {shares} | {right[3]:.2f} |")
    there = np.flatnonzero(~np.isnan(tables["adapted"]))
    print("\n| IoU of decoded labels, % |", " | ".join(NAMES[i] for i in there), "|")
    print("|---|" + "---:|" * len(there))
    for name, ious in tables.items():
        print(f"| {name} |", " | ".join(f"{100 * ious[i]:.0f}" for i in there), "|")


def autoencoder_figures(
    model: str, sensor: Sensor, scans: Sequence[Scan]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(4,) means of ``figures_of``, and (19,) the IoU of each class, NaN without a label.

    A model of another sensor is moved to the grid first; cells are sampled, as they are when scans
    are generated.
    """
    checkpoint = load_checkpoint(find_model(model))
    networks = checkpoint.networks
    if checkpoint.header.sensor != sensor:
        networks = regrid(checkpoint, sensor)[1]
    codec = Latent(networks[CODEC], checkpoint.header.tensors)  # type: ignore[arg-type]
    figures = []
    table = np.zeros((len(NAMES), len(NAMES)), np.int64)
    for i, scan in enumerate(tqdm(scans, desc="autoencoder", unit="scan")):
        image = project(scan, sensor, ["reflectance", "label"])
        noise = uniform(SEED, [i], (codec.draws, *sensor.shape), "cpu")
        x = codec.encode(codec.tensors.from_images([image]))
        [made] = codec.tensors.to_images(codec.decode(x, noise), sensor)
        figures.append(figures_of(image, made))
        label = made.channels["label"]
        decoded = labelled(image, made) & (label != IGNORE)
        np.add.at(table, (image.channels["label"][decoded], label[decoded]), 1)
    ious = np.where(table.sum(1) > 0, class_ious(table), np.nan)
    return np.mean(figures, axis=0), ious


def labelled(image: RangeImage, made: RangeImage) -> NDArray[np.bool_]:
    """The cells of returns in both images whose label is known."""
    return image.mask & made.mask & (image.channels["label"] != IGNORE)


def figures_of(image: RangeImage, made: RangeImage) -> list[float]:
    """The shares of right returns, of right labels, and of ranges within 5 cm; the mean error of
    ranges in metres."""
    both = image.mask & made.mask
    error = np.abs(image.range - made.range)
    equal = image.channels["label"] == made.channels["label"]
    return [
        (image.mask == made.mask).mean(),
        equal[labelled(image, made)].mean(),
        (both & (error < 0.05)).sum() / image.mask.sum(),
        error[both].mean(),
    ]


def features_table(
    name: str,
    extractor: Features,
    train: Sequence[Scan],
    test: Sequence[Scan],
    generated: dict[str, list[Scan]],
) -> None:
    """Print distances in one space of features. All scans are seen on the grid of the extractor."""

    def of(scans: Sequence[Scan]) -> NDArray[np.floating]:
        with torch.inference_mode():
            return np.concatenate([extractor([scan]) for scan in scans])

    known = of(train)
    reference = of(test)
    apart = np.linalg.norm(known[:, None] - known[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    near = np.median(apart.min(1))
    print(
        f"\n| features of {name} | Frechet distance | nearest training scan | nearer than the "
        "tests, % |\n|---|---:|---:|---:|"
    )
    print(
        f"| training scans | {frechet_distance(reference, known):.2f} | {near:.2f} | |"
    )
    for model, scans in generated.items():
        fake = of(scans)
        novelty = nearest_training(known, fake, reference)
        distance = frechet_distance(reference, fake)
        print(
            f"| {model} | {distance:.2f} | {np.median(novelty.generated):.2f} | "
            f"{100 * novelty.closer:.0f} |"
        )
    print(f"| test scans | | {np.median(novelty.held_out):.2f} | |")


if __name__ == "__main__":
    app = Typer()
    app.command()(pandaset)
    app.command()(measure)
    app()
