"""Metrics of realism. Names such as JSD or MMD have different definitions in different papers.
Every score therefore carries its protocol; scores of different protocols are not comparable.

To add a protocol, write a file in ``protocols/``; to add a kind of measure, a line of ``KINDS`` in
``measures.py``.
"""

from lidar_synth.lab.evaluate.comparison import evaluate
from lidar_synth.lab.evaluate.distances import (
    frechet_distance,
    jensen_shannon_distance,
    squared_mmd,
)
from lidar_synth.lab.evaluate.features import Extractor
from lidar_synth.lab.evaluate.intervals import Interval, bootstrap, extrapolated_frechet
from lidar_synth.lab.evaluate.loop_metric import Metric, Score
from lidar_synth.lab.evaluate.neighbours import manifold, nearest_training
from lidar_synth.lab.evaluate.protocols import PROTOCOLS, Protocol

__all__ = [
    "PROTOCOLS",
    "Extractor",
    "Interval",
    "Metric",
    "Protocol",
    "Score",
    "bootstrap",
    "evaluate",
    "extrapolated_frechet",
    "frechet_distance",
    "jensen_shannon_distance",
    "manifold",
    "nearest_training",
    "squared_mmd",
]
