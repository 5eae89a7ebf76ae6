"""Detection of data leakage: the recordings a model was trained on, and their overlap with
evaluation data.

A checkpoint's provenance lists under ``seen`` all recordings that influenced its weights: its own
training data and those of its teacher, its initial weights and its autoencoder.
"""

import hashlib
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lidar_synth.bank import Bank
from lidar_synth.datasets.recordings import (
    CONTENT,
    FILES,
    KITTI,
    KITTI_OBJECT,
    PLACES,
    TOWN,
    Recordings,
    all_frames,
    frames_of,
    seen_by,
)
from lidar_synth.errors import ConfigError
from lidar_synth.files.parsing import read_facts
from lidar_synth.formats import BankScans, layout_of
from lidar_synth.formats.models import models_of
from lidar_synth.formats.source import ScanFiles
from lidar_synth.generate.generator import Generator
from lidar_synth.generate.loading import load_generator
from lidar_synth.geometry import Scan, Source
from lidar_synth.lab.town.export import SETTINGS


def seen_by_model_of(path: Path, source: ScanFiles | None = None) -> Recordings | None:
    """The training data of the model that generated scans; empty if it is not known, None if no
    model did.

    Args:
        path: a folder of ``lidar-synth sample``, a bank, or a folder into which such scans were
            converted.
        source: its scans; the first one may say that a model made it, where nothing beside the
            scans does.

    Raises:
        FileError, DataError: if what stands beside them is damaged.
    """
    if models := models_of(path):
        return _of_models(models)
    by_model = (
        source is not None and next(iter(source)).provenance.get("made_by") == "model"
    )
    return Recordings() if by_model else None


def recordings_of(source: ScanFiles, layout: str, path: Path | str) -> Recordings:
    """The recordings in a source on disk.

    Args:
        source: the result of ``open_scans``.
        layout: its layout, a name of ``READERS``.
        path: its path as given by the user; represents scans of an unknown dataset.

    Raises:
        FileError, DataError: if the settings of an exported town are damaged.
    """
    settings = Path(os.path.expandvars(path)) / SETTINGS
    if settings.is_file():  # a town has the layout and the names of a dataset
        return town(read_facts(settings, "the settings of a town").get("seed", 0))
    made = next(iter(source)).provenance  # of all scans, or of the first one
    if made.get("made_by") == "town":  # converted to another format
        return town(made.get("seed", 0))
    if isinstance(source, BankScans):  # includes the training data of its model
        return all_frames(FILES, [str(path)]) | _of_bank(source.bank)
    if layout in PLACES:
        return frames_of(layout, source.ids)
    return all_frames(FILES, [str(path)])


def measured(
    source: ScanFiles,
    layout: str,
    path: Path,
    split: str | None,
    seen: Recordings | None = None,
) -> Recordings:
    """The recordings of a reference, and its path: data on which an evaluated model must not have
    been trained.

    The scans are read and hashed if the model has ``seen`` scans that only their hashes identify:
        these may lie in the
    layout of any dataset now.
    """
    found = recordings_of(source, layout, path) | all_frames(
        FILES, [str(path)] + ([f"{path}#{split}"] if split else [])
    )
    hashed = seen is not None and any(dataset == CONTENT for dataset, _ in seen.drives)
    return found | contents(map(content_of, source)) if hashed else found


def refuse_training_data(
    real: Source, generated: Source, split: str | None = None
) -> str:
    """Refuse a reference that contains scans that the model of the generated ones has seen. Sets
    that are not read from files are not checked.

    Args:
        real: the reference.
        generated: scans of a model.
        split: of the reference, if it was opened with one.

    Returns:
        What could not be checked; "" if nothing.

    Raises:
        ConfigError: if they share scans.
        FileError, DataError: if what stands beside the scans is damaged.
    """
    if not (isinstance(real, ScanFiles) and isinstance(generated, ScanFiles)):
        return ""
    seen = seen_by_model_of(generated.root, generated)
    if seen is None:
        return ""
    reference = measured(real, layout_of(real.root), real.root, split, seen)
    if shared := overlap(seen, reference):
        raise ConfigError(
            f"{real.root} as a reference for {generated.root}, whose model was trained on "
            f"{shared} of it",
            "scans that the model was not trained on",
            "Use another split, or a town with another seed; training_data=True "
            "(--training-data) compares anyway.",
        )
    if not seen:
        return (
            f"{generated.root} does not record its model's training data: overlap with "
            f"{real.root} was not checked"
        )
    if undecided(seen, reference):
        return (
            "KITTI's object set is a sample of the raw drives; whether the two sets share "
            "frames is not known"
        )
    return ""


def refuse_leaks(
    model: str, tested: Recordings, scans: Iterable[Scan] = ()
) -> Generator:
    """Load a generator, and refuse one that was trained on the places that are tested.

    Args:
        model: its name or path.
        tested: the recordings of the tested scans.
        scans: those of them that are known by their content only; read if the generator has learnt
            from such scans.

    Raises:
        ConfigError: if it was; the message names drives and frames. On a model that needs camera
            images.
    """
    generator = load_generator(model)
    if generator.condition == "camera":
        raise ConfigError(
            f"generator {model!r}, which needs camera images",
            "one that needs none, such as town",
        )
    seen = seen_by(generator.header.provenance)
    if any(dataset == CONTENT for dataset, _ in seen.drives):
        tested = tested | contents(map(content_of, scans))
    if shared := overlap(seen, tested):
        raise ConfigError(
            f"generator {model!r}, which was trained on places that are tested: {shared}",
            "a generator that has never seen them",
            "Choose another --model, or leave out the arm: --arm with the names of the others.",
        )
    return generator


def content_of(scan: Scan) -> str:
    """Hash of the points and the reflectance of a scan, which identifies it in any folder."""
    digest = hashlib.sha256(np.ascontiguousarray(scan.points, np.float32).tobytes())
    digest.update(np.ascontiguousarray(scan.reflectance, np.float32).tobytes())
    return digest.hexdigest()[:32]


def contents(hashes: Iterable[str]) -> Recordings:
    """Scans that their hashes identify, see ``content_of``."""
    return all_frames(CONTENT, hashes)


def overlap(seen: Recordings, reference: Recordings) -> Recordings:
    """The recordings of a reference on which a model was trained; paths are resolved before
    comparison."""
    return _resolved(seen) & _resolved(reference)


def undecided(seen: Recordings, reference: Recordings) -> bool:
    """Whether one is from KITTI's object set and the other from the raw drives from which that was
    sampled."""
    some, others = (
        {dataset for dataset, _ in part.drives} for part in (seen, reference)
    )
    return (KITTI in some and KITTI_OBJECT in others) or (
        KITTI_OBJECT in some and KITTI in others
    )


def town(seed: int) -> Recordings:
    """The town of a seed; the streets of its scans are the same in every layout."""
    return all_frames(TOWN, [f"seed {seed}"])


def _of_bank(bank: Bank) -> Recordings:
    return _of_models(facts.provenance for facts in bank.index.sources)


def _of_models(provenances: Iterable[Mapping[str, Any]]) -> Recordings:
    seen = Recordings()
    for provenance in provenances:
        seen |= seen_by(provenance)
    return seen


def _resolved(recordings: Recordings) -> Recordings:
    """The recordings with resolved paths."""
    result = Recordings()
    for (dataset, drive), frames in recordings.drives.items():
        if dataset == FILES:
            path, mark, split = drive.partition("#")
            drive = f"{Path(os.path.expandvars(path)).resolve()}{mark}{split}"
        result |= Recordings({(dataset, drive): frames})
    return result
