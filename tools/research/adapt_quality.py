"""How good an adapted model is on scans that it has not seen, beside the model that it was adapted
from.

    python tools/research/adapt_quality.py pandaset FRAMES OUT
    lidar-synth adapt town --scans OUT/adapt --out mine.safetensors
    python tools/research/adapt_quality.py measure mine.safetensors --train OUT/adapt --test OUT/test
        [--before town] [--judge FOLDER] [--count 60]

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

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from lidar_synth import load_generator, load_sensor, open_scans
from lidar_synth.datasets.classes import IGNORE, NAMES, PANDASET
from lidar_synth.files.parsing import read_arrays
from lidar_synth.formats import WRITERS
from lidar_synth.generate.checkpoint import CODEC, load_checkpoint
from lidar_synth.generate.codec import Latent
from lidar_synth.generate.loading import find_model
from lidar_synth.generate.regrid import regrid
from lidar_synth.geometry.projection import project
from lidar_synth.geometry.scan import Scan
from lidar_synth.geometry.sensor import Sensor
from lidar_synth.lab.evaluate.distances import frechet_distance
from lidar_synth.lab.evaluate.neighbours import nearest_training
from lidar_synth.lab.evaluate.segmentation import class_ious, load_judge
from lidar_synth.lab.evaluate.street_judge import load_archive
from lidar_synth.noise import uniform

LAST_LEARNT = 30
FIRST_TESTED = 60
SEED = 1
"""Seed of the noise."""

Features = Callable[[Sequence[Scan]], NDArray[np.floating]]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    write = commands.add_parser(
        "pandaset", help="write the frames to adapt to and those to test on"
    )
    write.add_argument("frames", type=Path)
    write.add_argument("out", type=Path)
    of = commands.add_parser("measure", help="the figures of an adapted checkpoint")
    of.add_argument("checkpoint", type=Path)
    of.add_argument(
        "--train", type=Path, required=True, help="the scans that it was adapted to"
    )
    of.add_argument(
        "--test", type=Path, required=True, help="scans that it has not seen"
    )
    of.add_argument(
        "--before", default="town", help="the model that it was adapted from"
    )
    of.add_argument("--judge", type=Path, help="an archive of lidar-bonnetal")
    of.add_argument(
        "--columns", type=int, help="width at which the judge looks [the archive's own]"
    )
    of.add_argument("--count", type=int, default=60, help="scans to generate")
    given = parser.parse_args()
    if given.command == "pandaset":
        prepare(given.frames, given.out)
    else:
        measure(given)


def prepare(frames: Path, out: Path) -> None:
    """Write the frames of PandaSet as the package's own scans."""
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


def measure(given: argparse.Namespace) -> None:
    """Print the tables."""
    train = list(open_scans(given.train))
    test = list(open_scans(given.test))
    sensor = load_checkpoint(given.checkpoint).header.sensor
    print(
        "| model | returns right, % | labels right, % | range within 5 cm, % | mean error of the "
        "range, m |"
    )
    print("|---|---:|---:|---:|---:|")
    models = {"before": given.before, "adapted": given.checkpoint}
    tables = {
        name: autoencoder_row(name, str(model), sensor, test)
        for name, model in models.items()
    }
    there = np.flatnonzero(~np.isnan(tables["adapted"]))
    print("\n| IoU of decoded labels, % |", " | ".join(NAMES[i] for i in there), "|")
    print("|---|" + "---:|" * len(there))
    for name, ious in tables.items():
        print(f"| {name} |", " | ".join(f"{100 * ious[i]:.0f}" for i in there), "|")
    generated = {
        name: generate(str(model), given.count) for name, model in models.items()
    }
    extractors: dict[str, Features] = {"the shipped segmenter": load_judge().features}
    if given.judge is not None:
        extractors["the archive"] = load_archive(given.judge, given.columns).features
    for name, extractor in extractors.items():
        features_table(name, extractor, train, test, generated)


def autoencoder_row(
    name: str, model: str, sensor: Sensor, scans: Sequence[Scan]
) -> NDArray[np.float64]:
    """Print a model's figures on encoded and decoded scans; return the IoU of each class, (19,),
    NaN without a label.

    A model of another sensor is moved to the grid first; cells are sampled, as they are when scans
    are generated.
    """
    checkpoint = load_checkpoint(find_model(model))
    networks = (
        checkpoint.networks
        if checkpoint.header.sensor == sensor
        else regrid(checkpoint, sensor)[1]
    )
    tensors = checkpoint.header.tensors
    codec = Latent(networks[CODEC], tensors)  # type: ignore[arg-type]
    sums = np.zeros(5)
    table = np.zeros((len(NAMES), len(NAMES)), np.int64)
    for i, scan in enumerate(tqdm(scans, desc=f"{name}, autoencoder", unit="scan")):
        image = project(scan, sensor, ["reflectance", "label"])
        noise = uniform(SEED, [i], (codec.draws, *sensor.shape), "cpu")
        [made] = tensors.to_images(
            codec.decode(codec.encode(tensors.from_images([image])), noise), sensor
        )
        both = image.mask & made.mask
        real = image.channels["label"]
        label = made.channels["label"]
        known = both & (real != IGNORE)
        error = np.abs(image.range - made.range)
        sums += [
            (image.mask == made.mask).mean(),
            (real == label)[known].mean(),
            (both & (error < 0.05)).sum() / image.mask.sum(),
            error[both].mean(),
            1,
        ]
        decoded = known & (label != IGNORE)
        np.add.at(table, (real[decoded], label[decoded]), 1)
    returns, labels, near, error = sums[:4] / sums[4]
    print(
        f"| {name} | {100 * returns:.1f} | {100 * labels:.1f} | {100 * near:.1f} | {error:.2f} |"
    )
    return np.where(table.sum(1) > 0, class_ious(table), np.nan)


def generate(model: str, count: int) -> list[Scan]:
    """Scans of a model, from the same noise for all models."""
    generator = load_generator(model)
    return [
        generator.scans(SEED, [i])[0]
        for i in tqdm(range(count), desc=Path(model).stem, unit="scan")
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
    print(
        f"\n| features of {name} | Frechet distance | nearest training scan | nearer than the "
        "tests, % |"
    )
    print("|---|---:|---:|---:|")
    print(
        f"| training scans | {frechet_distance(reference, known):.2f} | "
        f"{np.median(apart.min(1)):.2f} | |"
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
    main()
