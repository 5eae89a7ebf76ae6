"""Training of teachers and students: data, state, loop. Accelerate (extra ``train``) is needed only to run it."""

from lidar_synth.train.data import Batch, Batches, ImageCache, cache_scans, micro_batches
from lidar_synth.train.loop import Record, Task, steps, student_task, teacher_task
from lidar_synth.train.schedules import SCHEDULES
from lidar_synth.train.state import Recipe, Training

__all__ = [
    "SCHEDULES",
    "Batch",
    "Batches",
    "ImageCache",
    "Recipe",
    "Record",
    "Task",
    "Training",
    "cache_scans",
    "micro_batches",
    "steps",
    "student_task",
    "teacher_task",
]
