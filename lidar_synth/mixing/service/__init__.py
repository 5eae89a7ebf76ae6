"""Generation beside the trainer: in a process of its own through shared memory, or between the
steps on its device."""

from lidar_synth.mixing.service.batches import BatchMixer
from lidar_synth.mixing.service.rolling import RollingBank

__all__ = ["BatchMixer", "RollingBank"]
