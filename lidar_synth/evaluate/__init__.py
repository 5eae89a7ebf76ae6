"""Metrics of realism. Names such as JSD or MMD have different definitions in different papers. Every score therefore
carries its protocol; scores of different protocols are not comparable.

To add a protocol, write a file in ``protocols/``; to add a kind of measure, a line of ``KINDS`` in ``measures.py``.
"""

from lidar_synth.evaluate.comparison import evaluate
from lidar_synth.evaluate.distances import frechet_distance, jensen_shannon_distance, squared_mmd
from lidar_synth.evaluate.features import Extractor
from lidar_synth.evaluate.metric import Metric, Score
from lidar_synth.evaluate.protocols import PROTOCOLS, Protocol

__all__ = [
    "PROTOCOLS",
    "Extractor",
    "Metric",
    "Protocol",
    "Score",
    "evaluate",
    "frechet_distance",
    "jensen_shannon_distance",
    "squared_mmd",
]
