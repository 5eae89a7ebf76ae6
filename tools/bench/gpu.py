"""Scans per second of shipped models, and of a network of R2Flow's size, on a GPU.

    python tools/bench/gpu.py [MODEL ...] [--batch 1 --batch 16] [--dtype bfloat16] [--rounds N]
        [--device cuda]

From noise to the tensors of labelled scans: the flow's steps and the decoder, eager and compiled,
in turns. The network of R2Flow's size is this package's HDiT with random weights in 4 steps, as
``networks.py`` measures it. The last column is the share of the rate of a large matrix product; it
is left out for models whose operations are not counted. ``--device cpu`` tries the script without a
GPU, and leaves that network out.
"""

import time
from collections.abc import Callable, Iterator
from functools import partial
from statistics import median
from typing import Annotated, NamedTuple

import torch
from networks import EVALUATION, GRID, full_network
from timing import machine
from tqdm import tqdm
from typer import Argument, run

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


def of_model(
    model: str, batch: int, device: torch.device, dtype: torch.dtype
) -> Iterator[Row]:
    """The rows of a shipped model or a checkpoint."""
    load = partial(load_generator, model, device=device, dtype=dtype, batch=batch)
    both = [load(compile=False), load(compile=True)]
    for steps in (4, 2, 1):
        pair = (
            lambda g=g, s=steps: list(g.samples(0, range(batch), steps=s)) for g in both
        )
        yield Row(f"{model}, {steps} steps", batch, *pair)


def of_full_size(
    batches: list[int], device: torch.device, dtype: torch.dtype
) -> Iterator[Row]:
    """The rows of a network of R2Flow's size."""
    net = full_network(None).to(device, dtype)
    both = (net, torch.compile(net))
    for batch in batches:
        noise = torch.randn(batch, 2, 64, 1024, device=device)
        pair = (partial(solve, velocity, noise, GRID) for velocity in both)
        work = 4 * EVALUATION * batch
        yield Row("R2Flow's size, pixels, 4 steps", batch, *pair, work)


def table(
    models: list[str], batches: list[int], device: torch.device, dtype: torch.dtype
) -> Iterator[Row]:
    """The rows of the table."""
    for model in models:
        for batch in batches:
            yield from of_model(model, batch, device, dtype)
    if device.type != "cpu":
        yield from of_full_size(batches, device, dtype)


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


def print_row(row: Row, rate: float, measure: Callable[[Call], float]) -> None:
    """Measure a row and print it; ``rate`` is that of the product."""
    times = [measure(row.eager), measure(row.compiled)]
    share = f"{row.work / min(times) / rate:.0%}" if row.work else ""
    speed = " | ".join(f"{row.batch / t:.1f}" for t in times)
    tqdm.write(
        f"| {row.name} | {row.batch} | {speed} | {1e3 * min(times):.1f} | {share} |"
    )


def main(
    model: Annotated[list[str] | None, Argument()] = None,
    batch: list[int] | None = None,
    dtype: str = "bfloat16",
    rounds: int = 7,
    device: str = "cuda",
) -> None:
    """Prints the table."""
    torch.set_grad_enabled(False)
    place = check_device(device)
    kind = getattr(torch, dtype)
    measure = partial(seconds, device=place, rounds=rounds)
    size = 8192 if place.type == "cuda" else 2048
    a = torch.randn(size, size, device=place, dtype=kind)
    rate = 2 * size**3 / measure(lambda: a @ a)
    card = torch.cuda.get_device_name(place) if place.type == "cuda" else machine()
    print(
        f"\n### {card}, {dtype}, torch {torch.__version__}, {time.strftime('%Y-%m-%d')}\n"
    )
    print(f"product of {size} x {size}: {rate / 1e12:.2f} TFLOP/s\n")
    print(
        "| model | batch | eager, scans/s | compiled, scans/s | latency, ms | share of the "
        "product's rate |\n|---|---:|---:|---:|---:|---:|"
    )
    rows = table(model or ["town"], batch or [1, 16, 64], place, kind)
    for row in tqdm(list(rows), leave=False):
        print_row(row, rate, measure)


if __name__ == "__main__":
    run(main)
