"""What lies beside generated scans about the training data of their models: read, and kept by
conversions."""

import json
from pathlib import Path
from typing import Any

from lidar_synth.bank import Bank, is_bank, is_url
from lidar_synth.datasets.recordings import MODELS, NOTE
from lidar_synth.errors import DataError
from lidar_synth.files.disk import write_file
from lidar_synth.files.parsing import read_facts

Provenances = list[dict[str, Any]]
"""Of checkpoints; ``datasets.recordings.seen_by`` finds the training data in each."""


def models_of(path: str | Path) -> Provenances:
    """The provenances of the models that generated the scans at a path; empty if nothing beside the
    scans has them.

    Args:
        path: a folder of ``lidar-synth sample``, a bank or its URL, or a folder into which such
            scans were converted.

    Raises:
        FileError, DataError: if what lies beside them is damaged.
    """
    if is_url(path) or is_bank(path):
        return [dict(facts.provenance) for facts in Bank(path).index.sources]
    path = Path(path)
    found: Provenances = []
    if (path / NOTE).is_file():
        note = read_facts(path / NOTE, "the settings that lidar-synth sample wrote")
        found.append(
            {"data": note.get("trained_on")}
            | ({"seen": note["seen"]} if "seen" in note else {})
        )
    if (path / MODELS).is_file():
        expected = "what lidar-synth convert wrote about models"
        models = read_facts(path / MODELS, expected).get("models")
        if not isinstance(models, list) or not all(
            isinstance(model, dict) for model in models
        ):
            raise DataError(
                f"{path / MODELS} is damaged (no list of mappings)", expected
            )
        found += models
    return found


def write_models(root: Path, models: Provenances) -> None:
    """Write the provenances beside converted scans, where there are any; ``models_of`` reads them.

    Raises:
        FileError: if they cannot be written.
    """
    if models:
        write_file(root / MODELS, json.dumps({"models": models}).encode())
