"""What a checkpoint says of its making."""

import os
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from lidar_synth.datasets.recordings import Recordings, inherited
from lidar_synth.formats import BankScans, ScanFiles, layout_of
from lidar_synth.geometry import Sensor
from lidar_synth.lab.evaluate.leakage import recordings_of, town
from lidar_synth.lab.train.config import PARENTS, Data, Run

BESIDE = {
    "output",
    "data",
    "licence",
    "samples",
    "save_every",
    "sensor",
    "held_out",
    "rehearsal",
    *PARENTS,
}
"""Keys of a configuration that stand elsewhere in a header, or change nothing of the weights."""


def provenance_of(config: Run) -> dict[str, Any]:
    """What a checkpoint says of its making; the checkpoints that it was made from stand beside, by
    their hash."""
    facts: dict[str, Any] = {}
    if config.rehearsal is not None:
        facts["rehearsal"] = config.rehearsal.describe()
    return facts | {
        "data": config.data.describe(),
        "data_licence": config.data.licence,
        "licence": config.licence,
        "recipe": config.model_dump(mode="json", exclude=BESIDE),
        "software": f"lidar_synth {version('lidar_synth')}, torch {torch.__version__}",
    }


def recordings_known(
    config: Run, provenance: dict[str, Any], sensor: Sensor
) -> Recordings:
    """All recordings that the weights of a run will know: of the run itself, and of what it begins
    with.

    Args:
        config: of the run.
        provenance: of its checkpoint.
        sensor: of its scans.

    Raises:
        FileError, DataError: where the scans cannot be opened.
    """
    known = inherited(provenance) | _recordings(config.data, sensor)
    if config.held_out is not None:  # they chose the weights
        known |= _recordings(config.held_out.data, sensor)
    if config.rehearsal is not None:
        known |= _recordings(config.rehearsal, sensor)
    return known


def _recordings(data: Data, sensor: Sensor) -> Recordings:
    first, *more = data.parts()
    known = _recordings_of_one(first, sensor)
    for one in more:
        known |= _recordings(one, sensor)
    return known


def _recordings_of_one(data: Data, sensor: Sensor) -> Recordings:
    if data.seen is not None:
        return Recordings.from_list(data.seen)
    if data.path is None:
        return town(data.seed)
    source = data.open(sensor)
    assert isinstance(source, ScanFiles)
    layout = data.layout
    if isinstance(source, BankScans):  # maybe at a URL, which has no layout to look for
        layout = "bank"
    elif layout is None:
        layout = layout_of(Path(os.path.expandvars(data.path)))
    return recordings_of(source, layout, data.path)
