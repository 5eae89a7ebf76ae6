"""Training of a teacher: flow matching, from random weights or from those of a checkpoint."""

from dataclasses import replace

import torch

from lidar_synth.generate.checkpoint import CODEC, join
from lidar_synth.generate.flow.path import TIMESTEPS, flow_matching
from lidar_synth.lab.train.config import TrainConfig
from lidar_synth.lab.train.stage import Stage, Task
from lidar_synth.lab.train.start import open_networks


def teacher_task(timesteps: str = "uniform") -> Task:
    """Flow matching with t from one of ``TIMESTEPS`` (Eq. 1)."""
    return lambda batch: replace(
        flow_matching(batch.y0, batch.y1, TIMESTEPS[timesteps](batch.u)),
        cond=batch.cond,
    )


class TeacherStage(Stage):
    """The training of a rectified flow; raises as ``open_networks``."""

    def __init__(self, config: TrainConfig, device: torch.device | str) -> None:
        networks, header = open_networks(config)
        # The maps of such scans have the gaps of their projection, which the model learns.
        if config.data.path and "semantic" in header.conditioning:
            options = header.conditioning["semantic"] | {"keep_gaps": True}
            header = replace(
                header, conditioning=header.conditioning | {"semantic": options}
            )
        frozen = {name: part for name, part in networks.items() if name == CODEC}
        super().__init__(config, join(networks), header, frozen, device)
        self.task = teacher_task(config.timesteps)
