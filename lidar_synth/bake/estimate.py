"""How large a bank will be and how long it will take, by making a few scans of it."""

import time
from typing import NamedTuple

from lidar_synth.bake.job import BakePlan
from lidar_synth.bake.shard import generate, load_checked, one_computer
from lidar_synth.bank.chunks import deflate
from lidar_synth.bank.layout import head_size


class Estimate(NamedTuple):
    """Of a whole bake, by one worker like this one.

    Args:
        bytes: of all shards.
        seconds: of generating; what is written is packed meanwhile.
    """

    bytes: float
    seconds: float


def estimate(plan: BakePlan) -> Estimate:
    """Make two micro-batches, the first to warm up, and count on.

    Raises:
        ConfigError: where the device is not there.
    """
    job = plan.job
    generator, batch = load_checked(job, plan.facts), job.batch or 1
    with one_computer(job.threads):
        for _ in range(2):
            start = time.perf_counter()
            images = generate(generator, job, range(job.first, job.first + batch))
            seconds = time.perf_counter() - start
    size = sum(len(deflate(a)) for image in images for a in plan.facts.encoding.encode(image).values())
    heads = sum(head_size(plan.facts, entry.scans) for entry in plan.shards)
    return Estimate(heads + size / batch * job.count, seconds / batch * job.count)
