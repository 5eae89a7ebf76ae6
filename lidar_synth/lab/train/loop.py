"""The training loop: a generator that yields one record per optimiser step, so that any engine can
drive it.

Teacher and student differ only in the task, which makes an ``Example`` (input and target) of a
``Batch``. An autoencoder has its own loss. The caller logs, saves and stops; a saved ``Training``
resumes with the same losses.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from contextlib import nullcontext
from typing import TYPE_CHECKING, NamedTuple

from torch import Tensor
from torch.optim import Optimizer

from lidar_synth.errors import DataError
from lidar_synth.generate.flow.path import METRICS, Metric, velocity_loss
from lidar_synth.geometry.normalize import CHANNELS, TensorFormat
from lidar_synth.lab.train.data import Batches, InTurns, micro_batches
from lidar_synth.lab.train.schedules import SCHEDULES
from lidar_synth.lab.train.stage import Loss, Task
from lidar_synth.lab.train.state import Training

if TYPE_CHECKING:
    from accelerate import Accelerator


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
        total = 0.0
        evaluations = 0
        for positions, last in _positions(training, accelerator):
            with nullcontext() if last else accelerator.no_sync(network):
                with accelerator.autocast():
                    example = task(batches(positions))
                    part = loss(network, example, metric) / recipe.accumulate
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
        _move(optimizers, rate)
        training.step += 1
        if training.step % recipe.ema_every == 0:
            training.update_average()
        yield Record(training.step, total, gradient, rate, evaluations)


def _positions(
    training: Training, accelerator: "Accelerator"
) -> Iterator[tuple[range, bool]]:
    """The positions of this process in one step, micro-batch by micro-batch, and whether they are
    the last ones."""
    recipe = training.recipe
    parts = micro_batches(
        training.step,
        recipe.batch,
        recipe.accumulate,
        accelerator.process_index,
        accelerator.num_processes,
    )
    for number, positions in enumerate(parts, 1):
        yield positions, number == recipe.accumulate


def _move(optimizers: Iterable[Optimizer], rate: float) -> None:
    """Move the weights by their gradients, at this learning rate."""
    for optimizer in optimizers:
        for group in optimizer.param_groups:
            group["lr"] = rate
        optimizer.step()
        optimizer.zero_grad()
