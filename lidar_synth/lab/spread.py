"""Some of many scans."""

from collections.abc import Sequence

import numpy as np


def spread(indices: Sequence[int], count: int) -> list[int]:
    """At most ``count`` of the indices, evenly spread."""
    picks = np.unique(
        np.linspace(0, len(indices) - 1, min(count, len(indices))).round().astype(int)
    )
    return [indices[i] for i in picks]
