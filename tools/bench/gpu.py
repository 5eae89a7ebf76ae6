"""Scans per second of shipped models, and of a network of R2Flow's size, on a GPU.

    python tools/bench/gpu.py [MODEL ...] [--batch 1 16 64] [--dtype bfloat16] [--rounds N] [--device cuda]

From noise to the tensors of labelled scans: the flow's steps and the decoder, eager and compiled,
in turns. The network of R2Flow's size is this package's HDiT with random weights in 4 steps, as
``networks.py`` measures it. The last column is the share of the rate of a large matrix product; it
is left out for models whose operations are not counted. ``--device cpu`` tries the script without a
GPU, and leaves that network out.
"""

import argparse
import time
from collections.abc import Callable, Iterator
from statistics import median
from typing import NamedTuple

import torch
from networks import EVALUATION, GRID, full_network
from timing import machine
from tqdm import tqdm

from lidar_synth.generate.devices import check_device
from lidar_synth.generate.flow.solvers import solve
from lidar_synth.generate.loading import load_generator

Call = Callable[[], object]


class Row(NamedTuple):
    """A row of the table.

    Args:
        name: of the model.
        batch: scans of a call.
        eager, compiled: the two calls.
        work: floating point operations of a call; 0 = not counted.
    """

    name: str
    batch: int
    eager: Call
    compiled: Call
    work: float = 0.0


def table(
    models: list[str], batches: list[int], device: torch.device, dtype: torch.dtype
) -> Iterator[Row]:
    """The rows of the table."""
    for model in models:
        for batch in batches:
            both = [
                load_generator(
                    model, device=device, dtype=dtype, batch=batch, compile=c
                )
                for c in (False, True)
            ]
            for steps in (4, 2, 1):
                pair = (
                    lambda g=g, n=batch, s=steps: list(g.samples(0, range(n), steps=s))
                    for g in both
                )
                yield Row(f"{model}, {steps} steps", batch, *pair)
    if device.type == "cpu":
        return
    net = full_network(None).to(device, dtype)
    compiled = torch.compile(net)
    for batch in batches:
        noise = torch.randn(batch, 2, 64, 1024, device=device)
        pair = (lambda v=v, y=noise: solve(v, y, GRID) for v in (net, compiled))
        yield Row(
            "R2Flow's size, pixels, 4 steps", batch, *pair, 4 * EVALUATION * batch
        )


def seconds(call: Call, device: torch.device, rounds: int) -> float:
    """Median wall time of a call."""
    found = []
    for turn in range(rounds + 2):  # the first two compile and warm up
        start = time.perf_counter()
        call()
        if device.type == "cuda":
            torch.cuda.synchronize()
        found += [time.perf_counter() - start] if turn > 1 else []
    return median(found)


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("model", nargs="*", default=["town"])
    parser.add_argument("--batch", type=int, nargs="+", default=[1, 16, 64])
    parser.add_argument(
        "--dtype", choices=("bfloat16", "float16", "float32"), default="bfloat16"
    )
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--device", default="cuda")
    given = parser.parse_args()
    torch.set_grad_enabled(False)
    device = check_device(given.device)
    dtype = getattr(torch, given.dtype)
    size = 8192 if device.type == "cuda" else 2048
    a = torch.randn(size, size, device=device, dtype=dtype)
    rate = 2 * size**3 / seconds(lambda: a @ a, device, given.rounds)
    card = torch.cuda.get_device_name(device) if device.type == "cuda" else machine()
    print(
        f"\n### {card}, {given.dtype}, torch {torch.__version__}, {time.strftime('%Y-%m-%d')}\n"
    )
    print(f"product of {size} x {size}: {rate / 1e12:.2f} TFLOP/s\n")
    print(
        "| model | batch | eager, scans/s | compiled, scans/s | latency, ms | share of the "
        "product's rate |"
    )
    print("|---|---:|---:|---:|---:|---:|")
    for row in tqdm(list(table(given.model, given.batch, device, dtype)), leave=False):
        times = [
            seconds(call, device, given.rounds) for call in (row.eager, row.compiled)
        ]
        share = f"{row.work / min(times) / rate:.0%}" if row.work else ""
        speed = " | ".join(f"{row.batch / t:.1f}" for t in times)
        tqdm.write(
            f"| {row.name} | {row.batch} | {speed} | {1e3 * min(times):.1f} | {share} |"
        )


if __name__ == "__main__":
    main()
