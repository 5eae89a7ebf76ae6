"""The detector: a convolutional network in bird's-eye view with CenterPoint's head, its training
and its test."""

from collections.abc import Iterable, Sequence
from itertools import islice

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from tqdm import tqdm

from lidar_synth.geometry import Scan
from lidar_synth.lab.proof.detection.bev import (
    CHANNELS,
    REGRESSED,
    Found,
    Target,
    decode,
    targets,
    view,
)
from lidar_synth.lab.proof.detection.boxes import CLASSES, classes_of, detected
from lidar_synth.lab.train.precision import faster_in_bfloat16

PIXEL = 0.8
"""Side of a pixel of the output, metres."""
WIDTHS = (32, 64, 96)
DEPTHS = (1, 2, 3)
"""Channels and additional layers of the three levels."""
SHOWN_EVERY = 20
"""Iterations between two losses on the bar, each the mean of as many."""
RARE_HEAT = -4.6
"""Initial logit of the heat: few pixels hold a centre."""

Sample = tuple[Tensor, Target]


def sample(
    scan: Scan,
    rng: np.random.Generator,
) -> Sample:
    """The view and the targets of a scan with boxes."""
    boxes = detected(scan)
    return view(scan.points, scan.reflectance), targets(
        boxes.values, classes_of(boxes), PIXEL
    )


def collate(samples: Sequence[Sample]) -> Sample:
    """A batch of samples."""
    views, each = zip(*samples, strict=True)
    return torch.stack(views), Target(
        *(torch.stack(part) for part in zip(*each, strict=True))
    )


def _layer(
    inputs: int,
    outputs: int,
    stride: int = 1,
) -> nn.Sequential:
    convolution = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm2d(outputs), nn.ReLU(inplace=True))


class Detector(nn.Module):
    """Three levels, brought together on the grid of the first (0.5 M parameters)."""

    def __init__(self) -> None:
        super().__init__()
        first, second, third = WIDTHS
        levels = zip((CHANNELS, first, second), WIDTHS, DEPTHS, strict=True)
        self.levels = nn.ModuleList(
            nn.Sequential(_layer(i, o, 2), *(_layer(o, o) for _ in range(depth)))
            for i, o, depth in levels
        )
        self.up = nn.ModuleList(
            nn.Sequential(
                nn.ConvTranspose2d(width, first, scale, scale, bias=False),
                nn.BatchNorm2d(first),
                nn.ReLU(inplace=True),
            )
            for width, scale in ((second, 2), (third, 4))
        )
        last = nn.Conv2d(48, len(CLASSES) + REGRESSED, 1)
        self.head = nn.Sequential(_layer(3 * first, 48), last)
        assert last.bias is not None
        nn.init.constant_(last.bias[: len(CLASSES)], RARE_HEAT)

    def forward(self, views: Tensor) -> tuple[Tensor, Tensor]:
        """Logits of the heat (B, classes, n, n) and values (B, REGRESSED, n, n) of views (B,
        CHANNELS, 2n, 2n)."""
        found = []
        x = views
        for level in self.levels:
            x = level(x)
            found.append(x)
        joined = torch.cat(
            [found[0], *(up(x) for up, x in zip(self.up, found[1:], strict=True))], 1
        )
        out = self.head(joined).float()
        return out[:, : len(CLASSES)], out[:, len(CLASSES) :]


def answer(
    network: nn.Module,
    views: Tensor,
) -> tuple[Tensor, Tensor]:
    """The network on views (B, 2n, 2n, CHANNELS) uint8, which are moved to its device. The first
    layer is normalised, so that the scale of its input does not matter."""
    device = next(network.parameters()).device
    half = device.type != "cpu" or faster_in_bfloat16()
    seen = views.to(device, torch.bfloat16 if half else torch.float32)
    with torch.autocast(device.type, torch.bfloat16, enabled=half):
        logits, values = network(seen.permute(0, 3, 1, 2))
    return logits, values


def loss_of(
    logits: Tensor,
    values: Tensor,
    target: Target,
) -> Tensor:
    """CenterPoint's focal loss of the heat, and the absolute error of the values around centres."""
    p = logits.sigmoid()
    log_p = F.logsigmoid(logits)
    log_q = F.logsigmoid(-logits)
    centre = target.heat == 1
    heat = torch.where(
        centre, (1 - p) ** 2 * log_p, (1 - target.heat) ** 4 * p**2 * log_q
    )
    error = (values - target.values).abs() * target.weight[:, None]
    return -heat.sum() / centre.sum().clamp(
        min=1
    ) + error.sum() / target.weight.sum().clamp(min=1)


def train(
    network: Detector,
    batches: Iterable[Sample],
    iterations: int,
    rate: float,
    name: str,
) -> list[float]:
    """Train a network in place; the loss of every iteration. AdamW, one cycle of the learning
    rate."""
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    network.train()
    optimizer = torch.optim.AdamW(network.parameters(), rate, weight_decay=0.01)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, rate, total_steps=iterations
    )
    # In one tensor: small ones that stay among the large ones that go would fragment the memory.
    losses = torch.zeros(iterations, device=next(network.parameters()).device)
    done = 0
    bar = tqdm(
        islice(batches, iterations), name, iterations, mininterval=5, unit="iteration"
    )
    for views, target in bar:
        logits, values = answer(network, views)
        expected = Target(*(part.to(logits.device) for part in target))
        loss = loss_of(logits, values, expected)
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(network.parameters(), 10.0)
        optimizer.step()
        schedule.step()
        losses[done] = loss.detach()
        done += 1
        if done % SHOWN_EVERY == 0:  # it waits for a GPU
            bar.set_postfix(
                loss=f"{losses[done - SHOWN_EVERY : done].mean():.3f}", refresh=False
            )
    found: list[float] = losses[:done].tolist()
    return found


def detect(
    network: nn.Module,
    views: Iterable[Tensor],
) -> list[Found]:
    """The boxes that a network finds in each view; it is left in evaluation mode."""
    network.eval()
    every = []
    with torch.no_grad():
        for seen in views:
            logits, values = answer(network, seen[None])
            every.append(decode(logits[0].sigmoid().cpu(), values[0].cpu()))
    return every
