"""Configurations of teachers, autoencoders and students."""

from pathlib import Path
from typing import Any, Literal

import torch
from torch import nn

from lidar_synth.errors import ConfigError, choose
from lidar_synth.generate.checkpoint import CODEC, ENCODER, VELOCITY, NetworkSpec
from lidar_synth.generate.models import build_network, limit_modules, network_class
from lidar_synth.generate.models.network import Autoencoder, Encoder
from lidar_synth.generate.models.objective import Losses
from lidar_synth.geometry.normalize import NORMALISATIONS, TensorFormat
from lidar_synth.lab.train.config.sections import (
    ConditionSection,
    Count,
    NetworkSection,
    Run,
    Section,
)


class TrainConfig(Run):
    """A teacher, a rectified flow from noise to scans; or an autoencoder, if the network is one.

    Args:
        sensor: a preset's name or a YAML file.
        channels: channels of the range image, in order.
        normalisation: a name of ``NORMALISATIONS``.
        rays: the point of a cell whose angles the network sees: "centre", or "corner" as in R2Flow
            and LiDM.
        network: the network to train.
        codec: checkpoint of an autoencoder, for a latent model; it determines sensor, channels and
            normalisation. With ``init``, takes the place of that model's autoencoder.
        condition: the condition of the model.
        decoder: whether to train only the decoder of ``init``, a latent model, on the latents of
            its last step.
        init: checkpoint, or name of a shipped model, to start from; it determines networks, sensor,
            channels and normalisation.
        timesteps: a name of ``TIMESTEPS``.
        steps: number of steps of the uniform time grid with which the checkpoint samples.
        losses: weights of an autoencoder's losses.

    Example:
        >>> from lidar_synth.lab.train import TrainConfig, load_config
        >>> teacher = load_config(TrainConfig, "kitti360_teacher", ["data.path=KITTI-360"])
        >>> teacher.sensor, teacher.network.architecture, teacher.recipe.iterations
        ('hdl64e_kitti360', 'hdit', 320000)
    """

    sensor: str = "hdl64e_kitti360"
    channels: tuple[str, ...] = ("range", "reflectance")
    normalisation: str = "r2flow"
    rays: Literal["centre", "corner"] = "centre"
    network: NetworkSection = NetworkSection()
    codec: Path | None = None
    condition: ConditionSection | None = None
    init: Path | None = None
    decoder: bool = False
    timesteps: Literal[
        "uniform", "u_shaped", "logit_normal", "logit_normal_shifted"
    ] = "uniform"
    steps: Count = 50
    losses: Losses = Losses()

    @property
    def autoencodes(self) -> bool:
        """Whether an autoencoder is trained, and no flow."""
        return issubclass(network_class(self.network.architecture), Autoencoder)

    def tensors(self) -> TensorFormat:
        """Layout of the network's tensors.

        Raises:
            ConfigError: on an unknown channel or normalisation.
        """
        chosen = choose("normalisation", self.normalisation, NORMALISATIONS)
        return TensorFormat(self.channels, chosen)

    def parts(
        self, state: tuple[int, int, int], resolution: tuple[int, int]
    ) -> dict[str, NetworkSpec]:
        """The networks to train: the velocity (or the autoencoder) and the condition's encoder.

        Args:
            state: channels, rows and columns of the flow's states (or of the autoencoder's images).
            resolution: rows and columns of the sensor.

        Raises:
            ConfigError: on values that do not fit together.
        """
        run = {
            "resolution": list(state[1:]),
            "channels": state[0],
            "normalisation": self.normalisation,
        }
        derived = network_class(self.network.architecture).derived_arguments
        given: dict[str, Any] = {name: run[name] for name in derived}
        parts = {}
        if self.condition is not None:
            parts[ENCODER] = part = self.condition.part(resolution, state[1:])
            encoder = _checked(part)
            assert isinstance(encoder, Encoder)
            given[encoder.argument] = encoder.channels
        if twice := sorted(set(given) & set(self.network.arguments)):
            raise ConfigError(
                f"network.arguments with {twice}",
                "no such keys: they follow from what the states are",
            )
        part = NetworkSpec(self.network.architecture, given | self.network.arguments)
        _checked(part)
        return parts | {CODEC if self.autoencodes else VELOCITY: part}


MOST_MODULES = 4_000
"""Maximum number of modules of a network; a recipe may ask for 10^9 blocks."""


def _checked(part: NetworkSpec) -> nn.Module:
    """The network without weights: no memory and no time, only whether the values fit together."""
    with torch.device("meta"), limit_modules(MOST_MODULES):
        return build_network(*part)


class SelectionSettings(Section):
    """The selection of timesteps by ``timesteps.sum_costs``.

    Args:
        candidates: M, the number of candidate times.
        trajectories: number of the teacher's trajectories.
        batch: trajectories in a batch.
        seed: seed of their noise.
    """

    candidates: Count = 100
    trajectories: Count = 256
    batch: Count = 1
    seed: int = 0


class DistillConfig(Run):
    """A student that needs few steps.

    Args:
        teacher: checkpoint; its network, sensor, channels and normalisation are the student's.
        strategy: a name of ``STRATEGIES``.
        steps: Euler steps of the teacher in each interval.
        guidance: guidance scale of the teacher, which the student learns; 1 = none.
        weaker: checkpoint of a weaker teacher for autoguidance; without it, guidance is
            classifier-free.
        within: interval of the times at which autoguidance applies.
        intervals: N, the number of steps of the student.
        grid: N + 1 descending times from 1 to 0; without it, ``adaptive_piecewise`` selects them
            and the other strategies take uniform ones.
        also: other numbers of steps that the student learns as well, such as [2, 1]; it is then
            told where a step ends.
        selection: the selection of these times.
        init: checkpoint of a student of this teacher, or name of a shipped model, to train
            further; it determines networks and times. By default the teacher is the start.
    """

    teacher: Path
    init: Path | None = None
    strategy: Literal[
        "adaptive_piecewise",
        "uniform_piecewise",
        "piecewise_reflow",
        "reflow",
        "timestep_distillation",
    ] = "adaptive_piecewise"
    steps: Count = 20
    guidance: float = 1.0
    weaker: Path | None = None
    within: tuple[float, float] = (0.0, 1.0)
    intervals: Count = 4
    grid: tuple[float, ...] | None = None
    also: tuple[Count, ...] = ()
    selection: SelectionSettings = SelectionSettings()

    @property
    def selects(self) -> bool:
        """Whether timesteps are selected."""
        given = self.grid or self.init
        return given is None and self.strategy == "adaptive_piecewise"
