"""Small bakes for tests: plans on a quick model, and what a folder holds."""

from pathlib import Path
from typing import Any

from lidar_synth.bake import BakeJob, BakePlan, make_plan

COUNT, SIZE = 10, 3
"""Scans of a bank, and of a shard: 3, 3, 3 and 1."""


def plan_in(out: Path, model: Path, **settings: Any) -> BakePlan:
    """A plan with the tests' settings, or others."""
    return make_plan(out, BakeJob(**{"model": str(model), "count": COUNT, "shard_size": SIZE, "seed": 4} | settings))


def files(root: Path) -> dict[str, bytes]:
    """The files of a bank that is whole, by name; nothing half-made may be left beside them."""
    assert not list(root.rglob("*.part")) and not (root / ".lidar_synth").exists()
    return {path.name: path.read_bytes() for path in root.iterdir() if path.is_file()}
