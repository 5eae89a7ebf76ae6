"""Training of teachers and students: data, state, loop. Accelerate (extra ``train``) is needed only to run it."""

from lidar_synth.train.autoencoder import (
    Autoencoding,
    Losses,
    autoencoder_loss,
    reconstruct,
    reconstruction_figures,
    reconstruction_task,
)
from lidar_synth.train.cache import ImageCache, Other, cache_latents, cache_scans
from lidar_synth.train.data import Batch, Batches, Conditioning, micro_batches
from lidar_synth.train.decoding import Decoding, decoding_loss, decoding_task
from lidar_synth.train.loop import Loss, Record, Task, steps, student_task, teacher_task
from lidar_synth.train.optimizers import OPTIMIZERS
from lidar_synth.train.schedules import SCHEDULES
from lidar_synth.train.state import Recipe, Training

__all__ = [
    "OPTIMIZERS",
    "SCHEDULES",
    "Autoencoding",
    "Batch",
    "Batches",
    "Conditioning",
    "Decoding",
    "ImageCache",
    "Loss",
    "Losses",
    "Other",
    "Recipe",
    "Record",
    "Task",
    "Training",
    "autoencoder_loss",
    "cache_latents",
    "cache_scans",
    "decoding_loss",
    "decoding_task",
    "micro_batches",
    "reconstruct",
    "reconstruction_figures",
    "reconstruction_task",
    "steps",
    "student_task",
    "teacher_task",
]
