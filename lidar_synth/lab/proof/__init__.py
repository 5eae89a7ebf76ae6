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
from lidar_synth.lab.proof.trial import Job, Trainer, TrialOutcome, reference

__all__ = [
    "ARMS",
    "Arm",
    "ArmStage",
    "CommandTrainer",
    "Job",
    "Proof",
    "ProofSettings",
    "Row",
    "Trainer",
    "TrialOutcome",
    "prove",
    "reference",
]
