"""Peers' weights as checkpoints of this package, one file per peer; their conventions end here.

To add a peer: write its file, enter its reader in ``IMPORTERS``.
"""

from collections.abc import Callable, Mapping
from pathlib import Path

from torch import nn

from lidar_synth.generate.checkpoint import Header
from lidar_synth.generate.importers.lidm import read_lidm
from lidar_synth.generate.importers.r2flow import read_r2flow

IMPORTERS: dict[str, Callable[[Path], tuple[Header, Mapping[str, nn.Module]]]] = {
    "r2flow": read_r2flow,
    "lidm": read_lidm,
}
"""Readers of peers' files by the peer's name: a path to the header and the networks of a checkpoint."""
