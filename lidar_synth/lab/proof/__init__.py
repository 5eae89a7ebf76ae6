"""What synthetic scans add to your labelled scans: trainings with and without them, tested on
places left out.

``prove`` runs the comparison that ``lidar-synth prove`` runs. ``ARMS`` has the trainings that are
compared.
"""

from lidar_synth.lab.proof.arms import ARMS, Arm, ArmStage, Row
from lidar_synth.lab.proof.command import CommandTrainer
from lidar_synth.lab.proof.settings import ProofSettings
from lidar_synth.lab.proof.study import prove
from lidar_synth.lab.proof.summary import Proof
from lidar_synth.lab.proof.trial import Job, Outcome, Trainer, reference

__all__ = [
    "ARMS",
    "Arm",
    "ArmStage",
    "CommandTrainer",
    "Job",
    "Outcome",
    "Proof",
    "ProofSettings",
    "Row",
    "Trainer",
    "prove",
    "reference",
]
