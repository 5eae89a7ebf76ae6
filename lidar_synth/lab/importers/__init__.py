"""Importers of weights released by other projects (peers), one file per peer, which translate their
conventions.

To add a peer: write its file and enter its reader in ``IMPORTERS``.
"""

from collections.abc import Callable, Mapping
from pathlib import Path

from torch import nn

from lidar_synth.generate.checkpoint import Header
from lidar_synth.lab.importers.lidm import read_lidm
from lidar_synth.lab.importers.r2dm import read_r2dm
from lidar_synth.lab.importers.r2flow import read_r2flow

IMPORTERS: dict[str, Callable[[Path], tuple[Header, Mapping[str, nn.Module]]]] = {
    "r2flow": read_r2flow,
    "lidm": read_lidm,
    "r2dm": read_r2dm,
}
"""Readers by the peer's name; each maps a path to the header and the networks of a checkpoint."""
