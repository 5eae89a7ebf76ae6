"""Curation of banks: scores for unusual scans, and rules that drop scans by their scores.

``features`` measures one scan and ``store`` keeps the features of all scans on disk. ``duplicates``
finds similar scans (``neighbours`` does so in very large banks). ``scores`` scores a complete bank
and saves the scores in a file. ``rules`` selects the scans that a rule matches, and
``bake.edit.drop`` writes the curated bank.

To add a score of single scans, add a function to ``features.MEASURES``; to add one of a complete
bank, add a line to ``scores``.
"""

from lidar_synth.lab.curate.rules import matching
from lidar_synth.lab.curate.scores import (
    FILE,
    MEANINGS,
    Scores,
    read_scores,
    score,
    write_scores,
)
from lidar_synth.lab.curate.store import keep_features_in

__all__ = [
    "FILE",
    "MEANINGS",
    "Scores",
    "keep_features_in",
    "matching",
    "read_scores",
    "score",
    "write_scores",
]
