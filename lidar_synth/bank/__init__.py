"""Banks: folders of generated scans as range images in HDF5, "lidar-synth-bank/1", or /2 where they
have boxes.

``encoding`` and ``boxes`` convert range images to compact arrays, and ``chunks`` compresses them.
``shard`` reads one file of a bank, ``layout`` validates what such a file declares, ``storage``
reads byte ranges of files and URLs, ``writer`` writes a shard. ``facts`` are what the scans of a
bake have in common, ``index`` lists a bank's shards, ``reader`` offers a bank as a source of scans,
and ``card`` describes it to people and to data set tools. ``cache`` copies shards from a URL, in
the order of ``plans``.
"""

from lidar_synth.bank.encoding import Encoding
from lidar_synth.bank.facts import BOXED_FORMAT, FORMAT, Facts
from lidar_synth.bank.index import INDEX, Entry, Index
from lidar_synth.bank.reader import Bank, is_bank
from lidar_synth.bank.shard import ShardReader
from lidar_synth.bank.storage import is_url
from lidar_synth.bank.writer import ShardWriter

__all__ = [
    "BOXED_FORMAT",
    "FORMAT",
    "INDEX",
    "Bank",
    "Encoding",
    "Entry",
    "Facts",
    "Index",
    "ShardReader",
    "ShardWriter",
    "is_bank",
    "is_url",
]
