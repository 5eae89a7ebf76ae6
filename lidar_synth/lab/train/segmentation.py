"""The reference trainer: a small range-view segmenter on real scans with synthetic ones among them.

All that a training with mixed data takes, in one file: ``endless_batches`` is the data loading,
``train_segmenter`` the loop. ``tools/research/train_segmenter.py`` calls it from the command line,
on the town or on your own dataset.
"""

from collections.abc import Callable, Iterable, Iterator
from itertools import count

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils.data import DataLoader
from tqdm import tqdm

from lidar_synth.datasets.classes import IGNORE
from lidar_synth.errors import DataError
from lidar_synth.lab.evaluate.segmentation import Images
from lidar_synth.lab.evaluate.segmenter import segmenter_input
from lidar_synth.mixing import MixedScans

RATE = 4e-3
"""The highest learning rate."""
RAREST = 1e-4
"""Added to the share of each class, so that the rarest weighs at most 100."""


def endless_batches(
    mixed: MixedScans, batch: int, workers: int = 0
) -> Iterator[Images]:
    """Epoch after epoch of a mixture.

    Args:
        mixed: made with ``collate="range"``.
        batch: samples of a batch.
        workers: processes that load; 0 = this one.

    Yields:
        Batches of range images, the last one of an epoch too where it is smaller.
    """
    loader = DataLoader(
        mixed,
        batch_sampler=mixed.batches(batch),
        num_workers=workers,
        collate_fn=mixed.collate,
        persistent_workers=workers > 0,
    )
    for epoch in count():
        # another order, fresh synthetic scans; persistent workers are told
        mixed.set_epoch(epoch)
        yield from loader


def balanced_cross_entropy(logits: Tensor, target: Tensor) -> Tensor:
    """Cross-entropy over all labelled cells; the weight of a class is one over the square root of
    its share of the batch, so that poles and persons count beside roads.

    Args:
        logits: (B, C, H, W).
        target: (B, H, W) int64, classes 0 to C - 1 or ``IGNORE``, at least one of them a class.

    Returns:
        A scalar.
    """
    counts = torch.bincount(target[target != IGNORE], minlength=logits.shape[1])
    weight = (counts / counts.sum() + RAREST).rsqrt()
    return F.cross_entropy(logits.float(), target, weight, ignore_index=IGNORE)


def train_segmenter(
    network: nn.Module,
    batches: Iterable[Images],
    height: Tensor,
    steps: int,
    rate: float = RATE,
    progress: bool = True,
    half: bool = False,
    watch: Callable[[int], object] | None = None,
) -> list[float]:
    """``balanced_cross_entropy``, AdamW, one cycle of the learning rate.

    Args:
        network: a ``RangeSegmenter``, changed in place and left in evaluation mode.
        batches: at least ``steps`` of them.
        height: (H, W) sine of each cell's elevation, on the network's device.
        steps: optimiser steps.
        rate: the highest learning rate.
        progress: show a bar.
        half: compute the forward pass in bfloat16, in the channels-last memory format: three times
            as fast on a CPU with AMX, slower on one without bfloat16.
        watch: called with the number of steps done after each of them; it may use the network in
            evaluation mode.

    Returns:
        The loss of every step.

    Raises:
        DataError: where the batches end too soon, or one of them has no valid label.
    """
    optimizer = torch.optim.AdamW(network.parameters(), rate, weight_decay=0.01)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, rate, total_steps=steps)
    network.train()
    if half:
        network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    # In one tensor: small ones that stay among the large ones that go would fragment the memory.
    losses = torch.zeros(steps, device=height.device)
    done = 0
    bar = tqdm(total=steps, desc="segmenter", unit="step", disable=not progress)
    for _, batch in zip(range(steps), batches, strict=False):
        target = batch["label"].long()
        if not bool((target != IGNORE).any()):
            raise DataError(
                "a batch without one valid label",
                "at least one label that is not 255 = ignore",
            )
        inputs = segmenter_input(batch["range"], batch["reflectance"], height)
        with torch.autocast(inputs.device.type, torch.bfloat16, enabled=half):
            logits = network(inputs)
        loss = balanced_cross_entropy(logits, target.to(logits.device))
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        schedule.step()
        losses[done] = loss.detach()
        done += 1
        if watch is not None:
            watch(done)
            network.train()
        bar.update()
        if progress:  # it waits for a GPU
            bar.set_postfix(
                loss=f"{losses[max(0, done - 20) : done].mean():.3f}", refresh=False
            )
    bar.close()
    network.eval()
    if done < steps:
        raise DataError(f"{done} batches for {steps} steps", "as many batches as steps")
    values: list[float] = losses.tolist()
    return values
