"""What an adapted model is: its figures on held-out scans, its provenance, and its card in
Markdown.

Whether it repeats its training data is seen in the distances of generated scans to the nearest
training scan, beside those of held-out real scans, in the features of the shipped segmenter.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from lidar_synth.datasets.recordings import seen_by
from lidar_synth.files.disk import write_file
from lidar_synth.files.markdown import escape_markdown
from lidar_synth.generate.checkpoint import CODEC, Checkpoint, Header, join
from lidar_synth.generate.codec import make_codec
from lidar_synth.generate.generator import Generator
from lidar_synth.geometry import RangeImage, Scan
from lidar_synth.geometry.projection import unproject
from lidar_synth.lab.evaluate.neighbours import nearest_training
from lidar_synth.lab.evaluate.segmentation import load_judge
from lidar_synth.lab.train.adaptation.scans import HELD, TRAIN
from lidar_synth.lab.train.adaptation.stages import Work
from lidar_synth.lab.train.autoencoder import reconstruction_figures
from lidar_synth.lab.train.held_out import read_history

GENERATED = 24
"""Scans that are generated to look for copies."""


def figures(work: Work, made: Checkpoint) -> dict[str, Any]:
    """The figures of an adapted model, plain values.

    Returns:
        ``stages``: {name: steps, minutes, and the loss on held-out scans before and after};
            ``reconstruction``, of the
        held-out scans; ``nearest``: median distances to the nearest training scan.
    """
    found: dict[str, Any] = {"stages": {}}
    for name in work.stages:
        history = read_history(work.runs.folder_of(name))
        best = min(history, key=lambda m: m.loss)
        found["stages"][name] = {
            "steps": history[-1].step,
            "best_step": best.step,
            "minutes": round(history[-1].seconds / 60, 1),
            "loss_before": history[0].loss,
            "loss": best.loss,
        }
    train = work.scans.images(TRAIN)
    held = work.scans.images(HELD)
    if CODEC in made.networks:
        found["reconstruction"] = _reconstruction(made, held)
        if not work.scans.labelled:  # their labels are the autoencoder's own
            found["reconstruction"].pop("label_accuracy", None)
    found["nearest"] = _nearest(made, train, held)
    return found


def _reconstruction(made: Checkpoint, images: Sequence[RangeImage]) -> dict[str, float]:
    """Means over images of what the autoencoder keeps."""
    tensors = made.header.tensors
    codec: Any = make_codec(made.networks[CODEC], tensors, made.header.sensor.shape)
    rows = [
        reconstruction_figures(codec, tensors.from_images([image]), made.header.sensor)
        for image in images
    ]
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}


def _nearest(
    made: Checkpoint, train: Sequence[RangeImage], held: Sequence[RangeImage]
) -> dict[str, float]:
    generator = Generator(
        "adapted",
        join(made.networks),
        made.header,
        made.hash,
        autoencoder=made.networks.get(CODEC),
    )
    conditions = None
    if generator.condition is not None:  # label maps of scans that it has not seen
        conditions = np.stack(
            [held[i % len(held)].channels["label"] for i in range(GENERATED)]
        )
    with torch.inference_mode():
        generated = generator.scans(0, range(GENERATED), conditions)
    known, fake, others = (
        features(scans) for scans in (_scans(train), generated, _scans(held))
    )
    novelty = nearest_training(known, fake, others)
    apart = np.linalg.norm(known[:, None] - known[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    return {
        "generated": float(np.median(novelty.generated)),
        "held_out": float(np.median(novelty.held_out)),
        "training": float(np.median(apart.min(1))),
        "closer": novelty.closer,
    }


def features(scans: Sequence[Scan]) -> NDArray[np.floating]:
    """(n, D) features of the shipped segmenter."""
    judge = load_judge()
    return np.concatenate([judge.features([scan]) for scan in scans])


def _scans(images: Sequence[RangeImage]) -> list[Scan]:
    return [unproject(image) for image in images]


def provenance_of(
    name: str,
    model: Checkpoint,
    work: Work,
    made: Checkpoint,
    found: dict[str, Any],
) -> dict[str, Any]:
    """The provenance of an adapted model: what it was, what it learnt from, and how well."""
    return {
        "data": (
            f"{len(work.scans.train)} scans of {work.header.sensor.name}, "
            f"{len(work.scans.held_out)} held out"
        ),
        "data_licence": work.licence,
        "licence": work.licence,
        "adapted_from": name,
        "init": model.hash,
        "init_provenance": model.header.provenance,
        "labels": "those of the scans"
        if work.scans.labelled
        else "guesses of a model that learnt them on the town",
        "scans": {
            "train": list(work.scans.train),
            "held_out": list(work.scans.held_out),
        },
        "seen": seen_by(made.header.provenance).to_list(),
        "figures": found,
        "software": made.header.provenance["software"],
    }


def write_card(
    path: Path,
    checkpoint: Path,
    work: Work,
    header: Header,
    found: dict[str, Any],
) -> None:
    """Write the card of an adapted model."""
    facts = header.provenance
    near = found["nearest"]
    sensor = header.sensor
    model = escape_markdown(facts["adapted_from"])
    lines = [
        f"# {escape_markdown(checkpoint.stem)}",
        "",
        "```python",
        "from lidar_synth import load_generator",
        "",
        f"load_generator({checkpoint.name!r})",
        "```",
        "",
        f"It generates scans of {escape_markdown(sensor.name)} ({sensor.shape[0]} x "
        f"{sensor.columns} cells, {sensor.range_min:g} to {sensor.range_max:g} m). It is {model}, "
        f"adapted to {escape_markdown(facts['data'])}.",
        "",
        f"**Licence.** {escape_markdown(facts['licence'])}. The licence of {model} applies too.",
        "",
        f"**Labels.** They are {facts['labels']}.",
        "",
        f"**Scans.** Trained on {_span(work.scans.train)}; held out: {_span(work.scans.held_out)}. "
        "The checkpoint lists them, and tests on them are refused.",
        "",
        "stage | steps | minutes | loss on held-out scans before | after",
        "---|---:|---:|---:|---:",
        *(
            f"{name} | {s['best_step']} of {s['steps']} | {s['minutes']:g} | "
            f"{s['loss_before']:.3f} | {s['loss']:.3f}"
            for name, s in found["stages"].items()
        ),
        "",
    ]
    if "reconstruction" in found:
        lines += ["held-out scans, encoded and decoded |", "---|---:"]
        lines += [
            f"{_NAMES[name]} | {value:.3f}"
            for name, value in found["reconstruction"].items()
        ] + [""]
    lines += [
        "median distance to the nearest training scan (features of the shipped segmenter) |",
        "---|---:",
        f"of {GENERATED} generated scans | {near['generated']:.3f}",
        f"of held-out scans | {near['held_out']:.3f}",
        f"of training scans, to another one | {near['training']:.3f}",
        "",
        f"{near['closer']:.0%} of the generated scans are nearer to a training scan than 95 % of "
        "the held-out ones are. About 5 % are expected of new scans; many more are copies, or "
        "scans that are more ordinary.",
        "",
    ]
    write_file(path, "\n".join(lines).encode())


_NAMES = {
    "mae": "mean error of the range, metres",
    "within_5cm": "share of returns within 5 cm",
    "drop_accuracy": "share of cells whose return is right",
    "chamfer": "Chamfer distance, metres",
    "label_accuracy": "share of labels that are right",
}


def _span(ids: Sequence[str]) -> str:
    return f"{len(ids)} scans, {escape_markdown(ids[0])} to {escape_markdown(ids[-1])}"
