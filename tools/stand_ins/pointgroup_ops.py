"""The names of Pointcept's pointgroup_ops, which is compiled for CUDA only, to import Pointcept
without it."""

from typing import Any


def ballquery_batch_p(*args: Any) -> Any:
    """Needs a GPU, as PointGroup does."""
    raise RuntimeError(
        "pointgroup_ops needs a GPU; build libs/pointgroup_ops of Pointcept"
    )


bfs_cluster = ballquery_batch_p
