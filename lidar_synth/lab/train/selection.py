"""The timesteps of a student on disk, with the settings that decided them: others must not pass for
these."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.files.disk import write_arrays
from lidar_synth.files.parsing import parse_json, read_arrays
from lidar_synth.generate.checkpoint import Header
from lidar_synth.generate.flow.timesteps import Selection
from lidar_synth.lab.train.config import DistillConfig
from lidar_synth.lab.train.resume import flat


def selection_settings(config: DistillConfig, header: Header) -> dict[str, Any]:
    """All that decides which timesteps are selected, plain values.

    Args:
        config: of the student.
        header: of the student; its provenance holds the hashes of its teachers.
    """
    settings: dict[str, Any] = {
        "teacher": header.provenance["teacher"],
        "guidance": config.guidance,
        "intervals": config.intervals,
        "metric": config.recipe.metric,
        "precision": config.precision,
        # How many trajectories run at a time changes rounding only.
        "selection": config.selection.model_dump(exclude={"batch"}),
    }
    if config.weaker is not None:
        settings |= {
            "weaker": header.provenance["weaker"],
            "within": list(config.within),
        }
    if header.conditioning:  # each trajectory has the condition of a scan
        settings |= {"data": config.data.describe(), "seed": config.seed}
    return flat(json.loads(json.dumps(settings)))


def save_selection(path: Path, selection: Selection, settings: dict[str, Any]) -> None:
    """Write a selection and its settings, which stand there as JSON.

    Raises:
        FileError: where it cannot be written.
    """
    write_arrays(
        path,
        asdict(selection)
        | {"settings": np.array(json.dumps(settings, sort_keys=True))},
    )


def load_selection(path: Path, settings: dict[str, Any]) -> Selection:
    """A selection that was made with these settings.

    Raises:
        ConfigError: where it was made with other ones, which are named.
        DataError: where it is damaged.
    """
    found, made = _read(path)
    if other := sorted(
        key for key in made | settings if made.get(key) != settings.get(key)
    ):
        raise ConfigError(
            f"{path}, which was made with "
            + ", ".join(f"{key}={made.get(key)!r}" for key in other),
            ", ".join(f"{key}={settings.get(key)!r}" for key in other),
            "Remove it to select again, or give another output=FOLDER.",
        )
    return found


def _read(path: Path) -> tuple[Selection, dict[str, Any]]:
    """A selection and its settings."""
    values = read_arrays(path)
    try:
        found = Selection(
            tuple(values["grid"].tolist()),
            float(values["cost"]),
            float(values["uniform_cost"]),
            tuple(values["candidates"].tolist()),
            values["costs"],
            values["per_trajectory"],
        )
        return found, dict(parse_json(str(values["settings"]), str(path)))
    except (KeyError, ValueError, TypeError, AttributeError) as error:
        raise DataError(
            f"{path} is damaged ({error})", "a selection of timesteps"
        ) from error
