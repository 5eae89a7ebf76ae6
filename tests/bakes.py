"""Small bakes for tests: plans with a fast model, and the content of a bank's folder."""

from pathlib import Path
from typing import Any

from lidar_synth.bake import BakeJob, BakePlan, make_plan

COUNT = 10
SIZE = 3
"""Number of scans of a bank, and of a shard; the shards have 3, 3, 3 and 1 scans."""


def plan_in(out: Path, model: Path, **settings: Any) -> BakePlan:
    """A plan with the tests' default settings, updated by ``settings``."""
    return make_plan(
        out,
        BakeJob(
            **{"model": str(model), "count": COUNT, "shard_size": SIZE, "seed": 4}
            | settings
        ),
    )


def files(root: Path) -> dict[str, bytes]:
    """The files of a complete bank by name, after a check that no temporary file is left."""
    assert not list(root.rglob("*.part")) and not (root / ".lidar_synth").exists()
    return {path.name: path.read_bytes() for path in root.iterdir() if path.is_file()}
