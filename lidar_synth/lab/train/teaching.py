"""The flow that a student is distilled from: its teacher's, with or without guidance."""

from typing import Any

import torch
from torch import nn

from lidar_synth.errors import ConfigError
from lidar_synth.generate.checkpoint import (
    CODEC,
    VELOCITY,
    Checkpoint,
    join,
    load_checkpoint,
    network_hash,
)
from lidar_synth.generate.conditions import CONDITIONS, Conditioned, blank
from lidar_synth.generate.flow.path import Velocity, autoguide, guide
from lidar_synth.lab.train.config import DistillConfig


def target_flow(
    config: DistillConfig, teacher: Checkpoint, device: torch.device
) -> tuple[Velocity, dict[str, Any]]:
    """The velocity that a student is distilled from, and its part of the student's provenance.

    Args:
        config: of the student.
        teacher: the checkpoint of ``config.teacher``.
        device: of the training.

    Raises:
        ConfigError: on classifier-free guidance of a teacher without dropout of its condition, or a
            weaker model of other data.
    """
    made = {"teacher": teacher.hash, "teacher_provenance": teacher.header.provenance}
    velocity = _frozen_flow(teacher, config.compile)
    if config.weaker is not None:
        weaker = load_checkpoint(config.weaker, device)
        _check_weaker(config, teacher, weaker)
        made |= {"weaker": weaker.hash, "weaker_provenance": weaker.header.provenance}
        return autoguide(
            velocity,
            _frozen_flow(weaker, config.compile),
            config.guidance,
            config.within,
        ), made
    return velocity if config.guidance == 1 else _from_blank(
        config, teacher, velocity
    ), made


def _frozen_flow(checkpoint: Checkpoint, compiled: bool) -> nn.Module:
    """The flow of a checkpoint, with frozen weights."""
    velocity = join(checkpoint.networks).requires_grad_(False)
    if compiled:
        velocity.compile()
    return velocity


def _from_blank(
    config: DistillConfig, teacher: Checkpoint, velocity: nn.Module
) -> Velocity:
    """The teacher with classifier-free guidance."""
    if not isinstance(velocity, Conditioned):
        raise ConfigError(
            f"guidance {config.guidance} of an unconditional teacher",
            "1, or weaker=CHECKPOINT",
        )
    [(name, options)] = teacher.header.conditioning.items()
    if not options.get("dropout"):
        raise ConfigError(
            f"guidance {config.guidance} of a teacher that was trained without dropout of its "
            "condition",
            "1",
        )
    empty = torch.zeros(CONDITIONS[name].shape(velocity.encoder), dtype=torch.uint8)
    return guide(velocity, config.guidance, blank(name, empty))


def _check_weaker(
    config: DistillConfig, teacher: Checkpoint, weaker: Checkpoint
) -> None:
    """Both models need the same states and conditions."""
    if config.guidance == 1:
        raise ConfigError(
            f"weaker {config.weaker} with guidance 1",
            "a guidance scale other than 1, such as 2",
        )
    if not 0 <= config.within[0] < config.within[1] <= 1:
        raise ConfigError(
            f"within {config.within}", "two increasing times within [0, 1]"
        )
    if VELOCITY not in weaker.networks:
        raise ConfigError(
            f"weaker {config.weaker}, an autoencoder", "a model that generates"
        )
    differs = [
        k
        for k in ("sensor", "channels", "normalisation", "conditioning")
        if getattr(weaker.header, k) != getattr(teacher.header, k)
    ]
    if _hash_of_latents(weaker) != _hash_of_latents(teacher):
        differs.append("autoencoder")
    if differs:
        raise ConfigError(
            f"weaker {config.weaker} of another {', '.join(differs)}",
            f"those of {config.teacher}",
        )


def _hash_of_latents(checkpoint: Checkpoint) -> str:
    """Hash of the autoencoder of a latent model; "" for a pixel model."""
    return (
        network_hash(checkpoint.networks[CODEC]) if CODEC in checkpoint.networks else ""
    )
