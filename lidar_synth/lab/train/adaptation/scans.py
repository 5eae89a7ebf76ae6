"""A user's scans as an adaptation trains on them: checked, split by time, and kept as range images.

The last drives are held out, about a fifth of the scans. Of a single drive, or where the last one
is too long, the last fifth of the scans is held out, and the scans before it are left out, so that
no neighbouring frames lie on both sides.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from lidar_synth.datasets.classes import IGNORE
from lidar_synth.datasets.recordings import PLACES, TOWN, Recordings, frames_of
from lidar_synth.errors import DataError
from lidar_synth.files.disk import read_text, write_file
from lidar_synth.files.parsing import parse_json
from lidar_synth.formats import RangeImages, ScanFiles
from lidar_synth.formats.npz import write_range_image
from lidar_synth.generate.codec import Latent
from lidar_synth.geometry import RangeImage, Scan, Sensor, spread
from lidar_synth.geometry.agreement import MOST_OUTSIDE, agreement
from lidar_synth.geometry.normalize import TensorFormat
from lidar_synth.geometry.projection import project
from lidar_synth.lab.evaluate.leakage import content_of, contents, recordings_of

FEWEST = 12
MOST = 200
"""Scans that are needed, and that are used of more, evenly spaced."""
HELD_OUT = 0.2
GAP = 0.05
"""Shares of the scans that are held out, and that are left out before them."""
LEAST_LABELLED = 0.1
"""Share of the returns that have a label, below which a scan's labels are taken for those of
another table."""
TRAIN = "train"
HELD = "held_out"
NOTE = "scans.json"


@dataclass(frozen=True)
class Split:
    """Indices of scans in their source: to train on, left out, held out."""

    train: tuple[int, ...]
    between: tuple[int, ...]
    held_out: tuple[int, ...]


def split(names: Sequence[str]) -> Split:
    """Split scans by drives, or by time where the last drive is too long or too short to be held
    out.

    Args:
        names: of the scans in order, "drive/frame".

    Raises:
        DataError: on fewer than ``FEWEST`` scans.
    """
    count = len(names)
    if count < FEWEST:
        raise DataError(
            f"{count} scans", f"at least {FEWEST} to adapt a model, better 20 to 200"
        )
    picked = spread(range(count), MOST)
    first = len(picked) - round(HELD_OUT * len(picked))
    gap = max(1, round(GAP * len(picked)))
    drives = [names[i].rpartition("/")[0] for i in picked]
    begins = [n for n in range(1, len(picked)) if drives[n] != drives[n - 1]]
    fewest = HELD_OUT / 2
    most = 2 * HELD_OUT
    near = [n for n in begins if fewest <= 1 - n / len(picked) <= most]
    if near:
        first = min(near, key=lambda n: abs(n - first))
        gap = 0
    return Split(
        tuple(picked[: first - gap]),
        tuple(picked[first - gap : first]),
        tuple(picked[first:]),
    )


@dataclass(frozen=True)
class Prepared:
    """What is known of the prepared scans.

    Args:
        folder: with the folders ``TRAIN`` and ``HELD`` of range images.
        labelled: whether the scans have labels.
        train, held_out: ids of the scans.
        recordings: behind both.
    """

    folder: Path
    labelled: bool
    train: tuple[str, ...]
    held_out: tuple[str, ...]
    recordings: Recordings

    def path(self, part: str) -> Path:
        """The range images of a part."""
        return self.folder / part

    def images(self, part: str) -> list[RangeImage]:
        """The range images of a part, in order."""
        source = RangeImages(self.path(part))
        return [source.image(i) for i in range(len(source))]


def prepare(
    source: ScanFiles,
    layout: str,
    root: Path,
    sensor: Sensor,
    folder: Path,
    progress: bool = True,
) -> Prepared:
    """Check the scans, and write them as range images of ``sensor``; an interrupted call is
    continued.

    Args:
        source: the scans.
        layout: theirs, a name of ``READERS``.
        root: where they are.
        sensor: defines the grid.
        folder: to write to.
        progress: show a bar.

    Raises:
        DataError: on too few scans, scans of several sensors, some without labels, or labels of
            nearly nothing.
    """
    note = folder / NOTE
    if note.is_file():
        return _read(folder, parse_json(read_text(note), str(note)))
    parts = split(source.ids)
    usual = agreement(source[0].points, source.sensor).outside
    kinds: set[bool] = set()
    hashes: dict[str, list[str]] = {}
    for part, indices in ((TRAIN, parts.train), (HELD, parts.held_out)):
        for place, index in enumerate(
            tqdm(indices, desc=f"scans, {part}", unit="scan", disable=not progress)
        ):
            scan = source[index]
            kinds.add(_checked(scan, source.sensor, usual))
            if len(kinds) > 1:
                raise DataError(
                    f"scan {scan.id!r}: some scans have labels, some have none",
                    "labels for all or none",
                )
            hashes.setdefault(part, []).append(content_of(scan))
            channels = [
                name for name in ("reflectance", "label") if name in scan.fields()
            ]
            path = folder / part / f"{place:06d}.npz"
            path.parent.mkdir(parents=True, exist_ok=True)
            write_range_image(
                path, project(scan, sensor, channels), replace(scan, sensor=sensor)
            )
    ids = {
        part: [source.ids[i] for i in some]
        for part, some in ((TRAIN, parts.train), (HELD, parts.held_out))
    }
    recordings = _recorded(source, layout, root, ids[TRAIN] + ids[HELD]) | contents(
        hashes[TRAIN] + hashes[HELD]
    )
    values = {"labelled": kinds.pop(), **ids, "recordings": recordings.to_list()}
    write_file(note, json.dumps(values).encode())
    return _read(folder, values)


def _read(folder: Path, values: Any) -> Prepared:
    recordings = Recordings.from_list(values["recordings"])
    return Prepared(
        folder,
        values["labelled"],
        tuple(values[TRAIN]),
        tuple(values[HELD]),
        recordings,
    )


def _recorded(
    source: ScanFiles, layout: str, root: Path, ids: Sequence[str]
) -> Recordings:
    """The recordings of some scans of a source; of the whole one where frames cannot be told
    apart."""
    every = recordings_of(source, layout, root)
    if layout not in PLACES or any(dataset == TOWN for dataset, _ in every.drives):
        return every
    return frames_of(layout, ids)


def _checked(scan: Scan, sensor: Sensor, usual: float) -> bool:
    """Whether a scan has labels; ``usual`` is the share of points outside of the sensor's view.

    Raises:
        DataError: on a scan of another sensor, or with labels of nearly nothing.
    """
    outside = agreement(scan.points, sensor).outside
    if (
        scan.sensor.shape != sensor.shape
        or scan.sensor.name != sensor.name
        or outside > usual + MOST_OUTSIDE
    ):
        raise DataError(
            f"scan {scan.id!r} of sensor {scan.sensor.name!r}, with {outside:.0%} of the points "
            f"outside of the view of {sensor.name!r}",
            "scans of one sensor",
            "Adapt a model to each sensor by itself; --sensor names that of the scans.",
        )
    if scan.label is None:
        return False
    known = float((scan.label != IGNORE).mean())
    if known < LEAST_LABELLED:
        raise DataError(
            f"scan {scan.id!r} with labels for {known:.0%} of its points",
            "labels of the dataset's own table for most of them",
            "Labels of another table? Remove them to adapt without labels.",
        )
    return True


def drop_labels(image: RangeImage) -> RangeImage:
    """A range image whose cells have no label."""
    blank = np.full(image.sensor.shape, IGNORE, np.uint8)
    return RangeImage(image.range, image.sensor, {**image.channels, "label": blank})


@torch.no_grad()
def label(prepared: Prepared, codec: Latent, folder: Path) -> Prepared:
    """Give labels to scans without any: those of an autoencoder that has learnt to do without them.

    Args:
        prepared: scans without labels.
        codec: of the autoencoder.
        folder: to write the labelled range images to.
    """
    note = folder / NOTE
    if not note.is_file():
        for part in (TRAIN, HELD):
            for place, image in enumerate(prepared.images(part)):
                path = folder / part / f"{place:06d}.npz"
                path.parent.mkdir(parents=True, exist_ok=True)
                write_range_image(path, _labelled(image, codec))
        write_file(note, read_text(prepared.folder / NOTE).encode())
    return replace(prepared, folder=folder)


def _labelled(image: RangeImage, codec: Latent) -> RangeImage:
    tensors: TensorFormat = codec.tensors
    decoded = codec.decode(codec.encode(tensors.from_images([drop_labels(image)])))
    [made] = tensors.to_images(decoded, image.sensor)
    given = np.where(image.mask & made.mask, made.channels["label"], IGNORE).astype(
        np.uint8
    )
    return RangeImage(image.range, image.sensor, {**image.channels, "label": given})
