"""Configuration files of training runs.

What a run needs is built from the checked values by the caller, so that nothing below knows of
configurations.
"""

from lidar_synth.files.recipes import (
    Listed,
    command_of,
    find_recipe,
    published,
    validate,
)
from lidar_synth.lab.train.config.load import load_config, read_values
from lidar_synth.lab.train.config.models import (
    PARENTS,
    ModelConfig,
    ModelStage,
    find_model_file,
    load_model,
    published_models,
)
from lidar_synth.lab.train.config.sections import (
    ConditionSection,
    Data,
    HeldOut,
    NetworkSection,
    Run,
    Samples,
    Section,
)
from lidar_synth.lab.train.config.training import (
    DistillConfig,
    SelectionSettings,
    TrainConfig,
)

__all__ = [
    "PARENTS",
    "ConditionSection",
    "Data",
    "DistillConfig",
    "HeldOut",
    "Listed",
    "ModelConfig",
    "ModelStage",
    "NetworkSection",
    "Run",
    "Samples",
    "Section",
    "SelectionSettings",
    "TrainConfig",
    "command_of",
    "find_model_file",
    "find_recipe",
    "load_config",
    "load_model",
    "published",
    "published_models",
    "read_values",
    "validate",
]
