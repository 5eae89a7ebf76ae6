"""Training of teachers, autoencoders and students.

``run(config)`` trains as ``lidar-synth train RECIPE`` and ``lidar-synth distill`` do,
``train_model(plan)`` as ``lidar-synth train MODEL``; the parts below it (data, tasks, state, the
loop as a generator) serve trainings of your own. Running needs Accelerate (extra ``train``).
"""

from lidar_synth.generate.models.objective import Losses
from lidar_synth.lab.train.autoencoder import (
    Autoencoding,
    autoencoder_loss,
    reconstruct,
    reconstruction_figures,
    reconstruction_task,
)
from lidar_synth.lab.train.cache import ImageCache, Other, cache_latents, cache_scans
from lidar_synth.lab.train.config import DistillConfig, TrainConfig, load_config
from lidar_synth.lab.train.data import Batch, Batches, Conditioning, micro_batches
from lidar_synth.lab.train.decoder import Decoding, decoding_loss, decoding_task
from lidar_synth.lab.train.loop import Record, steps
from lidar_synth.lab.train.model_plan import ModelPlan, plan_model
from lidar_synth.lab.train.models import train_model
from lidar_synth.lab.train.optimizers import OPTIMIZERS
from lidar_synth.lab.train.runs import open_stage, run
from lidar_synth.lab.train.schedules import SCHEDULES
from lidar_synth.lab.train.stage import Loss, Stage, Task
from lidar_synth.lab.train.state import Recipe, Training
from lidar_synth.lab.train.student import student_task
from lidar_synth.lab.train.teacher import teacher_task

__all__ = [
    "OPTIMIZERS",
    "SCHEDULES",
    "Autoencoding",
    "Batch",
    "Batches",
    "Conditioning",
    "Decoding",
    "DistillConfig",
    "ImageCache",
    "Loss",
    "Losses",
    "ModelPlan",
    "Other",
    "Recipe",
    "Record",
    "Stage",
    "Task",
    "TrainConfig",
    "Training",
    "autoencoder_loss",
    "cache_latents",
    "cache_scans",
    "decoding_loss",
    "decoding_task",
    "load_config",
    "micro_batches",
    "open_stage",
    "plan_model",
    "reconstruct",
    "reconstruction_figures",
    "reconstruction_task",
    "run",
    "steps",
    "student_task",
    "teacher_task",
    "train_model",
]
