"""Curation of banks: what is odd about each scan, and a bank without the ones that are too odd.

``features`` measures one scan, ``store`` keeps the features of all on disk, ``duplicates`` finds scans that are alike
(``neighbours`` among very many), ``scores`` puts it together for a whole bank and keeps it in a file, ``rules`` says
which scans a rule means. ``bake.edit.drop`` makes the curated bank.

To add a score: a function in ``features.MEASURES``, or for what needs the whole bank a line in ``scores``.
"""

from lidar_synth.bake.curate.rules import matching
from lidar_synth.bake.curate.scores import FILE, MEANINGS, Scores, read_scores, score, write_scores
from lidar_synth.bake.curate.store import kept_in

__all__ = ["FILE", "MEANINGS", "Scores", "kept_in", "matching", "read_scores", "score", "write_scores"]
