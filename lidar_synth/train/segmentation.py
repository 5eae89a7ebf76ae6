"""Training of the range-view segmenter on batches of labelled range images."""

from collections.abc import Iterable

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from tqdm import tqdm

from lidar_synth.classes import IGNORE
from lidar_synth.errors import DataError
from lidar_synth.metrics.segmentation import Images
from lidar_synth.nets.segmenter import segmenter_input


def train_segmenter(
    network: nn.Module,
    batches: Iterable[Images],
    height: Tensor,
    steps: int,
    rate: float = 4e-3,
    progress: bool = True,
) -> list[float]:
    """Cross-entropy over all labelled cells, AdamW, one cycle of the learning rate.

    Args:
        network: a ``RangeSegmenter``, changed in place and left in evaluation mode.
        batches: at least ``steps`` of them.
        height: (H, W) sine of each cell's elevation.
        steps: optimiser steps.
        rate: the highest learning rate.
        progress: show a bar.

    Returns:
        The loss of every step.

    Raises:
        DataError: where the batches end too soon, or one of them has no valid label.
    """
    optimizer = torch.optim.AdamW(network.parameters(), rate, weight_decay=0.01)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, rate, total_steps=steps)
    network.train()
    losses: list[float] = []
    bar = tqdm(total=steps, desc="segmenter", unit="step", disable=not progress)
    for _, batch in zip(range(steps), batches, strict=False):
        target = batch["label"].long()
        if not bool((target != IGNORE).any()):
            raise DataError("a batch without one valid label", "at least one label that is not 255 = ignore")
        logits = network(segmenter_input(batch["range"], batch["reflectance"], height))
        loss = F.cross_entropy(logits, target, ignore_index=IGNORE)
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        schedule.step()
        losses.append(loss.item())
        bar.update()
        bar.set_postfix(loss=f"{np.mean(losses[-20:]):.3f}", refresh=False)
    bar.close()
    network.eval()
    if len(losses) < steps:
        raise DataError(f"{len(losses)} batches for {steps} steps", "as many batches as steps")
    return losses
