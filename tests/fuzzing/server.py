"""Processes that start at once: forks of a server that has imported all that they need."""

from multiprocessing import get_context
from multiprocessing.context import ForkServerContext

PRELOADED = [
    "lidar_synth.formats.convert",
    "lidar_synth.generate.checkpoint",
    "lidar_synth.generate.models",
    "lidar_synth.lab.train.config",
    "h5py",
    "hypothesis",
    "numba",
    "pytest",
    "yaml",
]
"""One list for all: a process has one server, which imports what was asked for when it started."""


def forkserver() -> ForkServerContext:
    """The context whose processes share nothing with one that went wrong; its server has no
    threads."""
    context = get_context("forkserver")
    context.set_forkserver_preload(PRELOADED)
    return context
