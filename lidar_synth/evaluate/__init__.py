"""Metrics of realism. Names such as JSD or MMD have different definitions in different papers. Every score therefore
carries its protocol; scores of different protocols are not comparable.

To add a protocol, write a module with ``cloud``, a description of a cloud, and ``compare``, and add a line to
``PROTOCOLS``.
"""

from lidar_synth.evaluate.distances import frechet_distance, jensen_shannon_distance, squared_mmd
from lidar_synth.evaluate.protocols import PROTOCOLS, Extractor, Protocol, Score, evaluate

__all__ = [
    "PROTOCOLS",
    "Extractor",
    "Protocol",
    "Score",
    "evaluate",
    "frechet_distance",
    "jensen_shannon_distance",
    "squared_mmd",
]
