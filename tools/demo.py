"""The whole package in a few minutes on one machine: scans mixed with synthetic ones, a comparison,
a page to look at.

    python tools/demo.py demo_out --scans 24

1. Writes scans of a procedural town in SemanticKITTI's layout, in place of your own labelled
   dataset, and scans of another town, on which segmenters are measured. With SEMANTICKITTI_ROOT
   set, that dataset is used instead: sequence 08 is held out, or the last sequence if there is no
   08. KITTI360_ROOT works too: its last labelled drive is held out, or the end of its only one.
   Without labels per scan (``lidar-synth label kitti360`` makes them) its scans are mixed and
   shown, and nothing is trained.
2. Bakes a bank of scans that the shipped model generates, and verifies it.
3. Trains a small segmenter on the labelled scans, without and with synthetic ones, with two or
  three seeds each.
4. Writes a page: real and synthetic scans side by side, the mixture, and the mIoU of both
    trainings.

Run it again to resume after a stop.
"""

import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Annotated

import numpy as np
from comparison import AUGMENTATION, Protocol, Result, compare
from numpy.typing import NDArray
from panels import classes_panel, mixture_panel, scores_panel
from typer import Argument, run

from lidar_synth import KITTI360, Bank, Scan, Source, open_scans
from lidar_synth.datasets.classes import NAMES
from lidar_synth.errors import DataError
from lidar_synth.files.disk import write_file
from lidar_synth.geometry.scan import REAL
from lidar_synth.viz import html_page

SHOWN = 4
"""Scans of each kind on the page."""

_TOWN_MODEL = (
    "The synthetic scans come from a model of a procedural town, which has not seen this dataset: "
    "they look like the town. For scans like yours, train a model on yours."
)


_LABEL = "lidar-synth label kitti360 {root} {root}"


@dataclass(frozen=True)
class Data:
    """The user's scans, or what stands in for them.

    Args:
        real: scans to train on; without labels, nothing is trained.
        held_out: scans of another place.
        name: what the page calls one of its scans.
        kind: the same in one word.
        notes: what else the page says about them.
        place: where the held-out scans are from.
    """

    real: Sequence[Scan]
    held_out: Sequence[Scan]
    name: str
    kind: str
    notes: str
    place: str = ""

    @property
    def labelled(self) -> bool:
        return all(scan.label is not None for scan in [*self.real, *self.held_out])


def command(*words: str) -> None:
    """Print a command of ``lidar-synth`` and run it as a user would."""
    print(f"\n$ lidar-synth {' '.join(words)}", flush=True)
    subprocess.run([sys.executable, "-m", "lidar_synth", *words], check=True)


def spread(
    source: Source, count: int, chosen: Sequence[int] | None = None
) -> list[Scan]:
    """At most ``count`` scans, evenly spread over a source or over some of its indices."""
    indices = list(range(len(source))) if chosen is None else chosen
    places = np.unique(
        np.linspace(0, len(indices) - 1, min(count, len(indices))).round().astype(int)
    )
    return [source[indices[i]] for i in places]


def town(out: Path, scans: int, seed: int) -> Data:
    """Scans of two towns; those of the first one take the place of the user's own."""
    words = (
        f"--scans {scans} --interval 1 --sensor hdl64e_lasers --layout semantic_kitti"
    )
    words += f" --jobs {os.cpu_count() or 1}"
    command("town", str(out / "town"), *words.split(), "--seed", str(seed))
    words += f" --seed {seed + 1} --no-camera"
    command("town", str(out / "other_town"), *words.split())
    notes = (
        "No real sensor measured these scans: no dataset was given, so scans of a procedural town "
        f"take the place of your real ones (seed {seed}). Set SEMANTICKITTI_ROOT to see your own "
        "data. The synthetic scans come from the "
        'model that ships with the package, "town"; it was trained on many more scans of the town of seed 0.'
    )
    return Data(
        list(open_scans(out / "town")),
        list(open_scans(out / "other_town")),
        "Scan of the town, in place of a real one",
        "town",
        notes,
        f"another town (seed {seed + 1})",
    )


def semantic_kitti(root: str, scans: int) -> Data:
    """SemanticKITTI, with a sequence held out: 08, or the last one."""
    source = open_scans(root, layout="semantic_kitti", split="all")
    # The test set has no labels.
    labelled = [i for i, name in enumerate(source.ids) if int(name[:2]) < 11]
    sequences = {
        key: list(found)
        for key, found in groupby(labelled, lambda i: source.ids[i][:2])
    }
    held_out = "08" if "08" in sequences else max(sequences)
    chosen = [i for key, found in sequences.items() if key != held_out for i in found]
    if not chosen:
        sys.exit(
            f"SEMANTICKITTI_ROOT={root} has one labelled sequence; expected two or more, to hold "
            "one out"
        )
    notes = (
        "Real scans: SemanticKITTI, sequences "
        f"{', '.join(k for k in sequences if k != held_out)}. {_TOWN_MODEL}"
    )
    real = spread(source, scans, chosen)
    other = spread(source, scans, sequences[held_out])
    place = f"sequence {held_out}, on which nothing was trained"
    return Data(real, other, "Real scan (SemanticKITTI)", "real", notes, place)


def kitti360(root: str, scans: int) -> Data:
    """KITTI-360, with labels per scan if they were made; the last drive, or the end of the only
    one, is held out."""
    name = "Real scan (KITTI-360)"
    try:
        source = KITTI360(root, "r2flow/train", labels=root)
    except DataError:
        real = spread(KITTI360(root, "r2flow/train"), scans)
        notes = (
            "Real scans: KITTI-360, without labels, so nothing was trained. Make them: "
            f"{_LABEL.format(root=root)}"
        )
        return Data(real, [], name, "real", notes)
    drives = {
        key: list(found)
        for key, found in groupby(
            range(len(source)), lambda i: source.ids[i].split("/")[0]
        )
    }
    *others, last = drives.values()
    chosen = [i for indices in others for i in indices] or last[
        : max(1, 3 * len(last) // 4)
    ]
    held_out = [i for i in last if i not in set(chosen)]
    notes = (
        f"Real scans: KITTI-360, {len(drives)} drives, with labels from its accumulated clouds. "
        f"{_TOWN_MODEL}"
    )
    place = (
        f"{'the last' if others else 'the end of the only'} labelled drive, on which nothing was "
        "trained"
    )
    return Data(
        spread(source, scans, chosen),
        spread(source, scans, held_out),
        name,
        "real",
        notes,
        place,
    )


def dataset(out: Path, scans: int, seed: int) -> Data:
    """The dataset that an environment variable names, or the town."""
    if root := os.environ.get("SEMANTICKITTI_ROOT"):
        return semantic_kitti(root, scans)
    if root := os.environ.get("KITTI360_ROOT"):
        return kitti360(root, scans)
    return town(out, scans, seed)


def shares(scans: Sequence[Scan]) -> NDArray[np.float64]:
    """(19,) share of each class in the labelled points of some scans."""
    labels = np.concatenate([scan.label for scan in scans if scan.label is not None])
    counts = np.bincount(labels[labels < len(NAMES)], minlength=len(NAMES))
    return counts / max(counts.sum(), 1)


def protocol_notes(protocol: Protocol, place: str) -> list[str]:
    """What a reader has to know to judge the figures."""
    return [
        f"Both trainings use the same {len(protocol.real)} labelled scans (the label budget), and "
        f"the same network, seeds, {protocol.steps} iterations of {protocol.batch} scans, and "
        f"augmentation: {AUGMENTATION}. They differ in the share of synthetic samples: 0 and "
        f"{100 * protocol.ratio:.0f} %. Each dot is the mIoU of one seed on "
        f"{len(protocol.held_out)} scans of {place}; the white line is the mean, ± the standard "
        "deviation.",
        "These are short trainings of a small network, made to finish in a minute or two: they "
        "show the procedure, and the mIoU is far below that of a full training. lidar-synth prove "
        "makes longer comparisons.",
    ]


def panels(protocol: Protocol, data: Data, result: Result | None) -> list[str]:
    """The panels of the page below the viewer."""
    labels = "none" if result is None else "generated"
    mixed = protocol.mixture(
        protocol.ratio, 0, labels=labels, to_sample=lambda scan, rng: scan
    )
    epoch = [mixed[i] for i in range(len(mixed))]
    kinds = (data.kind, "synthetic")
    made = [mixture_panel([scan.domain for scan in epoch], kinds)]
    if result is None:
        return made
    arms = [f"{data.kind} scans only", f"{data.kind} and synthetic scans"]
    scores = dict(zip(arms, result.scores(), strict=True))
    columns = {
        f"% of points, {kind}": shares([s for s in epoch if s.domain == d])
        for d, kind in enumerate(kinds)
    }
    without, with_synthetic = result.ious()
    columns[f"IoU %, {data.kind} only"] = without
    columns["IoU %, with synthetic"] = with_synthetic
    notes = [
        f"Points: labelled ones of the first epoch. IoU: on {data.place}, mean of the seeds; – : "
        "not there."
    ]
    made.append(scores_panel(scores, protocol_notes(protocol, data.place)))
    return [*made, classes_panel(columns, notes)]


def write_page(path: Path, data: Data, bank: Bank, made: list[str]) -> None:
    """Write the page, with some scans of each kind."""
    # The town stands in for real scans.
    real = [replace(scan, domain=REAL) for scan in spread(data.real, SHOWN)]
    names = (data.name, "Synthetic scan, generated in 4 steps")
    shown = real + spread(bank, SHOWN)
    text = html_page(
        shown,
        title="Real and synthetic scans",
        notes=data.notes,
        domains=names,
        panels=made,
    )
    write_file(path, text.encode())


def compared(protocol: Protocol) -> Result:
    """Train both arms and print their scores."""
    print(
        f"\nTraining without and with synthetic scans: {protocol.seeds} seeds, "
        f"{protocol.steps} iterations each"
    )
    result = compare(protocol)
    for name, scores in zip(("without", "with"), result.scores(), strict=True):
        values = ", ".join(f"{100 * score:.1f} %" for score in scores)
        print(f"mIoU {name} synthetic scans: {values}")
    return result


def main(
    out: Annotated[Path, Argument()] = Path("demo_out"), scans: int = 24, seed: int = 0
) -> None:
    """Runs all steps."""
    start = time.monotonic()
    command("doctor")
    data = dataset(out, scans, seed)
    folder = str(out / "bank")
    words = f"--model town --count {scans} --seed 1 --shard-size 16"
    command("bake", folder, *words.split())
    command("verify", folder, "--deep")
    bank = Bank(folder)
    steps, seeds = (40, 2) if scans < 12 else (120, 3)
    protocol = Protocol(data.real, list(bank), data.held_out, steps=steps, seeds=seeds)
    result = compared(protocol) if data.labelled else None
    page = out / "index.html"
    write_page(page, data, bank, panels(protocol, data, result))
    print(f"\n{time.monotonic() - start:.0f} s. The page is {page.resolve()}")


if __name__ == "__main__":
    run(main)
