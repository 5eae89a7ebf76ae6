"""Configuration files of training runs.

What a run needs is built from the checked values by the caller, so that nothing below knows of configurations.
"""

from lidar_synth.train.config.load import check, load_config, read_values, validated
from lidar_synth.train.config.recipes import Listed, find_recipe, published
from lidar_synth.train.config.sections import Condition, Data, HeldOut, Network, Run, Samples, Section
from lidar_synth.train.config.training import DistillConfig, SelectionSettings, TrainConfig

__all__ = [
    "Condition",
    "Data",
    "DistillConfig",
    "HeldOut",
    "Listed",
    "Network",
    "Run",
    "Samples",
    "Section",
    "SelectionSettings",
    "TrainConfig",
    "check",
    "find_recipe",
    "load_config",
    "published",
    "read_values",
    "validated",
]
