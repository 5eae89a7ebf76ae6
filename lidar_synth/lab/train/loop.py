"""The training loop: a generator that yields one record per optimiser step, so that any engine can
drive it.

Teacher and student differ only in the task, which makes an ``Example`` (input and target) of a
``Batch``. An autoencoder has its own loss. The caller logs, saves and stops; a saved ``Training``
resumes with the same losses.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from lidar_synth.errors import DataError
from lidar_synth.generate.flow.path import METRICS, Metric, velocity_loss
from lidar_synth.geometry.normalize import CHANNELS, TensorFormat
from lidar_synth.lab.train.data import Batch, Batches, InTurns, micro_batches
from lidar_synth.lab.train.schedules import SCHEDULES
from lidar_synth.lab.train.stage import Loss, Task
from lidar_synth.lab.train.state import Training

if TYPE_CHECKING:
    from accelerate import Accelerator


EVERY = 10
"""Steps after which a GPU is asked for its figures; in between, the processor does not wait for
it."""


class Record(NamedTuple):
    """The figures of one optimiser step.

    Args:
        step: number of the step, from 1.
        figures: (2,) loss and norm of the gradient, on the device.
        rate: learning rate of the step.
        teacher_evaluations: number in this step, one per sample and evaluation.
    """

    step: int
    figures: Tensor
    rate: float
    teacher_evaluations: int

    @property
    def loss(self) -> float:
        """Mean over the samples; waits for the device."""
        return float(self.figures[0])

    @property
    def gradient(self) -> float:
        """Norm of the gradient before clipping; waits for the device."""
        return float(self.figures[1])


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
    held: dict[Any, Tensor] = {}  # by device: each copy would wait for it

    def of_roots(a: Tensor, b: Tensor) -> Tensor:
        if a.device not in held:
            held[a.device] = torch.tensor(roots, device=a.device).view(1, -1, 1, 1)
        root = held[a.device].to(a.dtype)
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
            before that step, except that a GPU is asked after ``EVERY`` steps only, and Muon has
            moved by then.
    """
    recipe = training.recipe
    metric = weigh_metric(METRICS[recipe.metric], recipe.weights, batches.tensors)
    schedule = SCHEDULES[recipe.schedule]
    network: Any = accelerator.prepare(training.network)
    training.network.train()
    every = steps_between_figures(accelerator.device)
    recent: list[Record] = []
    numbers = range(training.step, recipe.iterations)
    place = (accelerator.process_index, accelerator.num_processes)
    parts = (
        part
        for step in numbers
        for part in micro_batches(step, recipe.batch, recipe.accumulate, *place)
    )
    made = _make_ahead(batches, parts, accelerator)
    for step in numbers:
        rate = recipe.rate * schedule(step, recipe.warmup, recipe.iterations)
        total = torch.zeros((), device=accelerator.device)
        evaluations = 0
        for number in range(recipe.accumulate):
            last = number == recipe.accumulate - 1
            with nullcontext() if last else accelerator.no_sync(network):
                with accelerator.autocast():
                    example = task(next(made))
                    part = loss(network, example, metric) / recipe.accumulate
                accelerator.backward(part)
            total += part.detach()
            evaluations += example.teacher_evaluations * accelerator.num_processes
        gradient = accelerator.clip_grad_norm_(network.parameters(), recipe.clip)
        mean = accelerator.reduce(total, "mean")
        figures = torch.stack((mean, torch.as_tensor(gradient).to(mean)))
        record = Record(step + 1, figures, rate, evaluations)
        recent.append(record)
        if record.step % every == 0 or record.step == recipe.iterations:
            try:
                read_figures(recent)
            except DataError:
                network.zero_grad()
                raise
            recent.clear()
        _move(training, rate, figures)
        training.step = record.step
        if training.step % recipe.ema_every == 0:
            training.update_average()
        yield record


def steps_between_figures(device: torch.device) -> int:
    """Steps after which a device is asked for its figures; a processor need not wait for itself."""
    return 1 if device.type == "cpu" else EVERY


def read_figures(records: Sequence[Record]) -> list[list[float]]:
    """The loss and the norm of the gradient of each record; waits once for the device.

    Raises:
        DataError: where one is not finite.
    """
    values: list[list[float]] = torch.stack([r.figures for r in records]).tolist()
    for record, (loss, gradient) in zip(records, values, strict=True):
        if not (math.isfinite(loss) and math.isfinite(gradient)):
            raise DataError(
                f"step {record.step}: the loss is {loss}, the norm of its gradient "
                f"{gradient}",
                "finite values",
                "The last saved state and checkpoint are kept. Lower the rate, or train without "
                "bf16.",
            )
    return values


def _make_ahead(
    batches: Batches | InTurns, parts: Iterable[range], accelerator: "Accelerator"
) -> Iterator[Batch]:
    """The batches at some positions; a thread makes the next one while the network computes."""
    on_gpu = accelerator.device.type == "cuda"
    stream = None
    if on_gpu:
        stream = torch.cuda.Stream(accelerator.device)  # type: ignore[no-untyped-call]

    def make(positions: range) -> Batch:
        with torch.cuda.stream(stream), accelerator.autocast():
            batch = batches(positions)
        if stream is not None:
            stream.synchronize()
        return batch

    with ThreadPoolExecutor(1) as thread:
        coming = None
        for positions in parts:
            ready = coming
            coming = thread.submit(make, positions)
            if ready is not None:
                yield _taken(ready.result())
        if coming is not None:
            yield _taken(coming.result())


def _taken(batch: Batch) -> Batch:
    """A batch whose memory is not given to the next one while the network computes with it."""
    for values in batch:
        if values is not None and values.device.type == "cuda":
            values.record_stream(torch.cuda.current_stream(values.device))
    return batch


def _move(training: Training, rate: float, figures: Tensor) -> None:
    """Move the weights by their gradients, at this learning rate.

    AdamW stands still, on the device, where the figures are not finite.
    """
    bad = (~figures.isfinite().all()).float()
    for optimizer in training.optimizers:
        if optimizer.defaults.get("fused"):  # other steps do not read it
            optimizer.found_inf = bad  # type: ignore[attr-defined]
        for group in optimizer.param_groups:
            group["lr"] = rate
        optimizer.step()
        optimizer.zero_grad()
