"""Estimates a bank's size and the time it takes, from a few scans."""

import time
from typing import NamedTuple

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
    """

    bytes: float
    seconds: float


def estimate(plan: BakePlan) -> Estimate:
    """Generate two batches, the first one to warm up, and extrapolate from the second one.

    Raises:
        ConfigError: if the device is not available.
    """
    job = plan.job
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
    return Estimate(heads + chunks / batch * job.count, seconds / batch * job.count)
