"""Estimates a bank's size and the time it takes, from a few scans."""

import time
from typing import NamedTuple

import torch

from lidar_synth.bake.job import BakePlan
from lidar_synth.bake.shard import generate, load_checked, torch_threads
from lidar_synth.bank.chunks import deflate
from lidar_synth.bank.layout import head_size


class Estimate(NamedTuple):
    """The expected size and time of a complete bake.

    Args:
        bytes: size of all shards.
        seconds: time that one worker on this machine needs to generate the scans; compression runs
            in parallel.
        device: on which it was measured; "cpu" where the GPUs are in other machines.
    """

    bytes: float
    seconds: float
    device: str


def estimate(plan: BakePlan) -> Estimate:
    """Generate two batches, the first one to warm up, and extrapolate from the second one.

    Raises:
        ConfigError: if the checkpoint has changed since the plan was made.
    """
    job = plan.job
    if job.device == "cuda" and not torch.cuda.is_available():
        job = job.model_copy(update={"device": "cpu", "batch": 1})
    generator = load_checked(job, plan.facts)
    batch = job.batch or 1
    with torch_threads(job.threads):
        for _ in range(2):
            start = time.perf_counter()
            images = generate(generator, job, range(job.first, job.first + batch))
            seconds = time.perf_counter() - start
    chunks = sum(
        len(deflate(a))
        for image in images
        for a in plan.facts.encoding.encode(image).values()
    )
    heads = sum(head_size(plan.facts, entry.scans) for entry in plan.shards)
    size = heads + chunks / batch * job.count
    return Estimate(size, seconds / batch * job.count, job.device)
