"""The tables of the town (catalogue.yaml), and random draws from them."""

from collections.abc import Sequence
from importlib.resources import files
from typing import Any, TypeVar

import numpy as np
import yaml

from lidar_synth.files.parsing import json_checksum

Rng = np.random.Generator
RGB = tuple[float, float, float]
Option = TypeVar("Option")


def _read_tables() -> dict[str, Any]:
    text = files("lidar_synth.lab.town").joinpath("catalogue.yaml").read_text("utf-8")
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    return dict(yaml.load(text, loader))


TABLES = _read_tables()
"""The tables by name; the file says what their columns are."""
TABLES_HASH = json_checksum(TABLES)[:16]
"""Tells a town from one of other tables, whose scans differ."""


def pick(options: dict[Option, float] | Sequence[Option], rng: Rng) -> Option:
    """One of the options: of a sequence, each is as likely; of a dictionary, a key is as likely as
    its share. The shares need not sum to 1."""
    if not isinstance(options, dict):
        return options[int(rng.integers(len(options)))]
    shares = np.array(list(options.values()))
    place = int(rng.choice(len(shares), p=shares / shares.sum()))
    return list(options)[place]


def pick_name(table: str, rng: Rng) -> str:
    """One of the options of a line of the table ``choices``."""
    name: str = pick(TABLES["choices"][table], rng)
    return name


def pick_colour(palette: str, rng: Rng) -> RGB:
    """One of the colours of a palette."""
    red, green, blue = pick(TABLES["palettes"][palette], rng)
    return red, green, blue


def sample_range(limits: float | list[float], rng: Rng) -> float:
    """A number between two limits, or the only one that is given."""
    if isinstance(limits, list):
        low, high = limits
        return rng.uniform(low, high)
    return limits
