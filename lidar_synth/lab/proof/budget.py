"""How long a comparison takes, and what of it fits into a limit of time."""

import time
from collections.abc import Sequence
from dataclasses import replace
from math import ceil

import numpy as np
import torch

from lidar_synth.bake.shard import torch_threads
from lidar_synth.errors import ConfigError
from lidar_synth.geometry import Scan
from lidar_synth.lab.evaluate.segmenter import RangeSegmenter
from lidar_synth.lab.proof.plan import Pair, ProofPlan
from lidar_synth.lab.proof.pools import SKIN_STREETS
from lidar_synth.lab.proof.settings import ProofSettings
from lidar_synth.lab.train.precision import faster_in_bfloat16
from lidar_synth.lab.train.segmentation import train_segmenter

TOWN_SECONDS = 0.5
SKIN_SECONDS = 1.5
GENERATOR_SECONDS = 1.0
"""Processor time for a scan of the town, a scan that a skin is learnt from, and a generated
scan."""
OVERHEAD = 1.3
"""Time of a training over that of its steps: loading, tests, a busy machine."""


def estimate_minutes(plan: ProofPlan, pairs: Sequence[Pair]) -> float:
    """The time that some pairs take, with the pools that they need."""
    settings = plan.settings
    pools = {pool for row in plan.rows for pool in row.arm.pools()}
    seconds = sum(map(plan.seconds, plan.rows)) * len(plan.trainings(pairs))
    seconds *= OVERHEAD
    town = settings.synthetic * TOWN_SECONDS
    if "skin" in pools:
        for place in {served[0][0] for served in plan.trainings(pairs)}:
            scans = len(plan.skin_scans(place))
            seconds += town + scans * SKIN_SECONDS + 2 * SKIN_STREETS * TOWN_SECONDS
    seconds += town * len(pools & {"town", "learnt"})
    if "generator" in pools:
        seconds += settings.synthetic * GENERATOR_SECONDS
    return seconds / 60 / plan.jobs


def within(plan: ProofPlan, minutes: float | None, resumed: bool = False) -> ProofPlan:
    """The plan with as many pairs as fit into the time, or with two pairs of fewer iterations. The
    pairs of one training stay together.

    Args:
        plan: of all pairs.
        minutes: limit of the time; None for all pairs.
        resumed: whether trainings with these iterations exist, so that they cannot be fewer.

    Raises:
        ConfigError: if two pairs do not fit even with ten iterations.
    """
    count = len(plan.pairs)
    together = 1 if plan.training is None else len(plan.places)
    if minutes is not None:
        while count > 0 and estimate_minutes(plan, plan.pairs[:count]) > minutes:
            count -= together
        least = min(max(2, together), len(plan.pairs))
        if count < least and not resumed:
            plan = _with_fewer_iterations(plan, least, minutes)
        count = max(count, least)
    pairs = plan.pairs[:count]
    labelled = {pair: plan.labelled[pair] for pair in pairs}
    return replace(
        plan, pairs=pairs, labelled=labelled, minutes=estimate_minutes(plan, pairs)
    )


def _with_fewer_iterations(plan: ProofPlan, least: int, minutes: float) -> ProofPlan:
    """The plan with as many iterations, a multiple of ten, as fit for some pairs."""
    for count in range(plan.settings.iterations // 10 * 10, 0, -10):
        shorter = replace(plan, settings=replace(plan.settings, iterations=count))
        needed = estimate_minutes(shorter, plan.pairs[:least])
        if needed <= minutes:
            return shorter
    raise ConfigError(
        f"{minutes:g} minutes, in which {least} places cannot be tested",
        f"about {ceil(needed)} or more",
        "Give more --minutes or fewer arms (--arm).",
    )


def measure_step(
    scans: list[Scan], settings: ProofSettings, half: bool | None, device: str = "cpu"
) -> tuple[bool, float]:
    """Whether bfloat16 is faster on this device, and the seconds of an iteration."""
    if settings.columns is None:
        return False, 0.0
    from lidar_synth.lab.proof.trial import images

    sensor = scans[0].sensor
    parts = images(scans, sensor)
    batch = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
    height = torch.from_numpy(np.sin(sensor.ray_angles()[0])).to(device)
    times: list[float] = []

    def watch(step: int) -> None:
        height.max().item()  # waits for a GPU
        times.append(time.perf_counter())

    with torch_threads(1):
        if half is None:
            half = height.device.type != "cpu" or faster_in_bfloat16()
        train_segmenter(
            RangeSegmenter(widths=settings.widths).to(device),
            [batch] * 4,
            height,
            4,
            progress=False,
            half=half,
            watch=watch,
        )
    return half, float(np.diff(times).min())
