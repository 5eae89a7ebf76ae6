"""Configuration files of training runs.

What a run needs is built from the checked values by the caller, so that nothing below knows of configurations.
"""

from lidar_synth.train.config.load import check, load_config, read_values, validated
from lidar_synth.train.config.sections import Condition, Data, Network, Run, Samples, Section
from lidar_synth.train.config.training import DistillConfig, Selection, TrainConfig

__all__ = [
    "Condition",
    "Data",
    "DistillConfig",
    "Network",
    "Run",
    "Samples",
    "Section",
    "Selection",
    "TrainConfig",
    "check",
    "load_config",
    "read_values",
    "validated",
]
