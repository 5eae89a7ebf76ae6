"""First measures of realism. A name such as JSD or MMD means different things in different papers, so that
every figure carries the protocol it was measured by; figures of two protocols are not comparable.

To add a protocol: one file with ``cloud``, what is kept of a cloud, and ``compare``; one line in ``PROTOCOLS``.
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
