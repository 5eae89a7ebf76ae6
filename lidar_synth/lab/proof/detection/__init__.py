"""``prove`` for detectors: what synthetic scans and pasted objects add to a few real scans with
boxes.

``prove_detection`` trains a small detector in bird's-eye view in several ways (``ARMS``) and tests
it on places that no training has seen.
"""

from lidar_synth.lab.proof.detection.arms import ARMS, DetectionArm
from lidar_synth.lab.proof.detection.study import DetectionSettings, prove_detection

__all__ = ["ARMS", "DetectionArm", "DetectionSettings", "prove_detection"]
