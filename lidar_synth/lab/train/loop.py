"""The training loop: a generator that yields one record per optimiser step, so that any engine can
drive it.

Teacher and student differ only in the task, which makes an ``Example`` (input and target) of a
``Batch``. An autoencoder has its own loss. The caller logs, saves and stops; a saved ``Training``
resumes with the same losses.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

from torch import Tensor, nn

from lidar_synth.errors import DataError
from lidar_synth.generate.flow.distill import STRATEGIES, every_piece
from lidar_synth.generate.flow.path import (
    METRICS,
    TIMESTEPS,
    Example,
    Metric,
    Velocity,
    flow_matching,
    velocity_loss,
)
from lidar_synth.geometry.normalize import CHANNELS, TensorFormat
from lidar_synth.lab.train.data import Batch, Batches, InTurns, micro_batches
from lidar_synth.lab.train.schedules import SCHEDULES
from lidar_synth.lab.train.state import Training

if TYPE_CHECKING:
    from accelerate import Accelerator

Task = Callable[[Batch], Example]
"""Makes the example of a batch: the state and time at which the network is trained, and the target
velocity."""

Loss = Callable[[nn.Module, Example, Metric], Tensor]
"""The scalar loss of a network on an example, with the recipe's metric."""


def teacher_task(timesteps: str = "uniform") -> Task:
    """Flow matching with t from one of ``TIMESTEPS`` (Eq. 1)."""
    return lambda batch: replace(
        flow_matching(batch.y0, batch.y1, TIMESTEPS[timesteps](batch.u)),
        cond=batch.cond,
    )


def student_task(
    strategy: str, teacher: Velocity, grid: Sequence[float], steps: int
) -> Task:
    """Distillation of ``teacher`` by one of ``STRATEGIES`` on the student's ``grid`` with ``steps``
    Euler steps of the teacher per piece (Algorithm 1)."""

    def task(batch: Batch) -> Example:
        example = STRATEGIES[strategy](
            teacher, batch.y0, batch.y1, batch.u, grid, steps, batch.cond
        )
        return replace(example, cond=batch.cond)

    return task


def several_steps_task(
    teacher: Velocity, grids: Sequence[Sequence[float]], steps: int
) -> Task:
    """Distillation of ``teacher`` for several numbers of steps (``every_piece``)."""
    return lambda batch: every_piece(
        teacher, batch.y0, batch.y1, grids, steps, batch.cond
    )


class Record(NamedTuple):
    """The figures of one optimiser step.

    Args:
        step: number of the step, from 1.
        loss: mean over the samples of this process.
        gradient: norm of the gradient before clipping.
        rate: learning rate of the step.
        teacher_evaluations: number in this process and step, one per sample and evaluation.
    """

    step: int
    loss: float
    gradient: float
    rate: float
    teacher_evaluations: int


def weigh_metric(
    metric: Metric, weights: Mapping[str, float], tensors: TensorFormat
) -> Metric:
    """A metric of tensors whose channels are multiplied by the roots of their weights."""
    if not weights:
        return metric
    roots = [
        weights.get(name, 1.0) ** 0.5
        for name in tensors.channels
        for _ in range(CHANNELS[name])
    ]

    def of_roots(a: Tensor, b: Tensor) -> Tensor:
        root = a.new_tensor(roots).view(1, -1, 1, 1)
        return metric(root * a, root * b)

    return of_roots


def steps(
    training: Training,
    task: Task,
    batches: Batches | InTurns,
    accelerator: "Accelerator",
    loss: Loss = velocity_loss,
) -> Iterator[Record]:
    """Train to the end of the recipe, step by step.

    Args:
        training: the run, at its first step or as it was loaded; changed in place.
        task: what to train on.
        batches: the data.
        accelerator: Accelerate's: one process or several, its precision.
        loss: what is lowered.

    Yields:
        A record after each step; between two of them ``training`` may be saved or sampled from.

    Raises:
        DataError: where the loss or its gradient is not finite; ``training`` is left as it was
            before that step.
    """
    recipe = training.recipe
    metric = weigh_metric(METRICS[recipe.metric], recipe.weights, batches.tensors)
    schedule = SCHEDULES[recipe.schedule]
    network, *optimizers = accelerator.prepare(training.network, *training.optimizers)
    training.network.train()
    while training.step < recipe.iterations:
        rate = recipe.rate * schedule(training.step, recipe.warmup, recipe.iterations)
        for group in (
            group for optimizer in optimizers for group in optimizer.param_groups
        ):
            group["lr"] = rate
        parts = list(
            micro_batches(
                training.step,
                recipe.batch,
                recipe.accumulate,
                accelerator.process_index,
                accelerator.num_processes,
            )
        )
        total = 0.0
        evaluations = 0
        for positions in parts:
            with (
                nullcontext()
                if positions is parts[-1]
                else accelerator.no_sync(network)
            ):
                with accelerator.autocast():
                    example = task(batches(positions))
                    part = loss(network, example, metric) / len(parts)
                accelerator.backward(part)
            total += accelerator.reduce(part.detach(), "mean").item()
            evaluations += example.teacher_evaluations * accelerator.num_processes
        gradient = float(accelerator.clip_grad_norm_(network.parameters(), recipe.clip))
        if not (math.isfinite(total) and math.isfinite(gradient)):
            network.zero_grad()
            raise DataError(
                f"step {training.step + 1}: the loss is {total}, the norm of its gradient "
                f"{gradient}",
                "finite values",
                "The last saved state and checkpoint are kept. Lower the rate, or train without "
                "bf16.",
            )
        for optimizer in optimizers:
            optimizer.step()
            optimizer.zero_grad()
        training.step += 1
        if training.step % recipe.ema_every == 0:
            training.update_average()
        yield Record(training.step, total, gradient, rate, evaluations)
