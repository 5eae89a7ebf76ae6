"""Speed of the full HDiT (80.9 M parameters) at 64 x 1024, against a large matrix product.

    python tools/bench/networks.py [--rounds N] [--threads N] [--model FILE.safetensors]
    python tools/bench/networks.py --training hdit|unet [--batch N] [--rounds N]

On a CPU: seconds of one evaluation, its rate relative to the product's, a profile by kind of
operation, peak memory; ``gpu.py`` measures the network on a GPU. Rates count the operations that
the network needs, not those of an implementation. The weights are random unless a checkpoint of the
same size is given.

With --training: a training step of the full HDiT, or of LiDM's U-Net (257.8 M parameters) on
latents, and the share of its processor time outside the network and its gradient: data, noise,
optimiser, average. With one thread, which tells the two apart on a busy machine too.
"""

import resource
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch
from accelerate import Accelerator
from timing import machine, seconds
from torch import Tensor, nn
from torch.profiler import ProfilerActivity, profile
from tqdm import tqdm
from typer import run

from lidar_synth.generate.checkpoint import VELOCITY, load_checkpoint
from lidar_synth.generate.flow.path import velocity_loss
from lidar_synth.generate.models import build_network
from lidar_synth.generate.models.hdit.hdit import HDiT
from lidar_synth.geometry import load_sensor
from lidar_synth.geometry.normalize import NORMALISATIONS, TensorFormat
from lidar_synth.lab.train.cache import ImageCache
from lidar_synth.lab.train.data import Batches
from lidar_synth.lab.train.loop import steps
from lidar_synth.lab.train.state import Recipe, Training
from lidar_synth.lab.train.teacher import teacher_task

EVALUATION = 156.4e9
"""Floating point operations of one evaluation: 153.1e9 in linear layers, the rest in attention."""
PRODUCT = 2 * 4096**3
"""Those of the product."""
GRID = (1.0, 0.86, 0.58, 0.22, 0.0)
"""LiDAR-Flow's time grid of the pixel model."""
KINDS = {
    "matrix products": ("mm", "addmm", "bmm"),
    "attention (products, softmax)": ("scaled_dot_product",),
    "gather, concatenate, copy": ("index_select", "cat", "copy_", "clone"),
    "gelu": ("gelu",),
    "RMS norms": ("pow", "mean", "sum", "rsqrt", "div_"),
    "other element-wise": ("mul", "add", "sub", "lerp", "sin", "cos", "sigmoid"),
}


def full_network(model: Path | None) -> Any:
    """The checkpoint's network, or one with random nonzero weights."""
    if model is not None:
        return load_checkpoint(model).networks[VELOCITY]
    torch.manual_seed(0)
    net = HDiT(
        (64, 1024), angles=torch.from_numpy(load_sensor("hdl64e_kitti360").ray_angles())
    )
    for parameter in net.parameters():
        if parameter.ndim == 2 and not parameter.any():
            nn.init.trunc_normal_(parameter, std=0.02)
    return net.eval()


def on_cpu(net: Any, rounds: int) -> None:
    """Evaluation and product in turns, then the profile."""
    y = torch.randn(1, net.channels, 64, 1024)
    a, b = torch.randn(2, 4096, 4096)
    product = []
    evaluation = []
    busy = []
    net(y, 0.5)
    for _ in tqdm(range(rounds), desc="timing", leave=False):
        product.append(seconds(lambda: a @ b))
        before = time.process_time()
        evaluation.append(seconds(lambda: net(y, 0.5)))
        busy.append(time.process_time() - before)
    print(
        f"\n### One evaluation on the CPU, {torch.get_num_threads()} threads, "
        f"float32\n\n{machine()}; torch {torch.__version__}; median (best) of {rounds}\n"
    )
    print("| what | s | GFLOP/s | share of the product's rate |\n|---|---:|---:|---:|")
    print_rate("product of 4096 x 4096", PRODUCT, product, product)
    print_rate("HDiT, batch 1", EVALUATION, evaluation, product)
    print(
        f"\nThe processor was busy for {median(busy):.2f} s per evaluation, all threads together."
    )
    breakdown(net, y)


def breakdown(net: nn.Module, y: Tensor) -> None:
    """Print the share of each kind of operation in the time."""
    with profile(activities=[ProfilerActivity.CPU]) as profiler:
        net(y, 0.5)
    spent: dict[str, float] = defaultdict(float)
    for event in profiler.key_averages():
        name = event.key.removeprefix("aten::").lstrip("_")
        kind = next(
            (k for k, names in KINDS.items() if any(name.startswith(n) for n in names)),
            "other",
        )
        spent[kind] += event.self_cpu_time_total
    print("\n| kind of operation | share of the time |\n|---|---:|")
    for kind in sorted(spent, key=lambda k: -spent[k]):
        print(f"| {kind} | {spent[kind] / sum(spent.values()):.1%} |")


def peak_memory(model: Path | None) -> float:
    """Peak memory of a fresh process in GB, including Python and torch."""
    given = [] if model is None else ["--model", model]
    out = subprocess.run(
        [sys.executable, __file__, "--peak", *given],
        check=True,
        capture_output=True,
        text=True,
    )
    return float(out.stdout)


def print_rate(
    name: str, work: float, times: list[float], product: list[float]
) -> None:
    """Print a row: median and best of the seconds, the rate, and its share of the product's."""
    found = [median(times), min(times)]
    rates = [work / t / 1e9 for t in found]
    shares = [
        rate * t / PRODUCT * 1e9
        for rate, t in zip(rates, (median(product), min(product)), strict=True)
    ]
    print(
        f"| {name} | {found[0]:.3f} ({found[1]:.3f}) | {rates[0]:.0f} ({rates[1]:.0f}) "
        f"| {shares[0]:.0%} ({shares[1]:.0%}) |"
    )


def training_of(kind: str, batch: int, rounds: int) -> tuple[Training, Batches]:
    """A run of the network ``kind`` on random scans, in memory."""
    sensor = load_sensor("hdl64e_kitti360")
    rng = np.random.default_rng(0)
    fields = {
        "range": rng.integers(0, 65536, (16, *sensor.shape), dtype=np.uint16),
        "reflectance": rng.integers(0, 256, (16, *sensor.shape), dtype=np.uint8),
    }
    tensors = TensorFormat(("range", "reflectance"), NORMALISATIONS["r2flow"])
    data = Batches(ImageCache(fields, sensor), tensors, flip=True)
    net = full_network(None)
    if kind == "unet":
        net = build_network("unet", {"resolution": (16, 128)})
        latents = rng.normal(size=(16, 2, 8, 16, 128)).astype(np.float16)
        data = replace(data, latents=latents)
    return Training(net, Recipe(iterations=rounds, batch=batch)), data


def on_training(kind: str, batch: int, rounds: int) -> None:
    """Print the time of a step, and its share outside the network."""
    training, data = training_of(kind, batch, rounds + 1)
    accelerator = Accelerator(cpu=True)
    inside = [0.0]

    def timed(call: Callable[..., Any]) -> Callable[..., Any]:
        def measured(*arguments: Any) -> Any:
            start = time.thread_time()
            result = call(*arguments)
            inside[-1] += time.thread_time() - start
            return result

        return measured

    accelerator.backward = timed(accelerator.backward)
    whole = []
    run = steps(training, teacher_task(), data, accelerator, timed(velocity_loss))
    start = time.process_time()
    for _ in tqdm(run, total=rounds + 1, desc="steps", leave=False):
        whole.append(time.process_time() - start)
        inside.append(0.0)
        start = time.process_time()
    spent = sum(whole[1:])  # the first step makes the moments
    outside = spent - sum(inside[1:])
    print(
        f"\n### A training step of {kind}, batch {batch}, on the CPU, 1 thread, float32\n\n"
        f"{machine()}; torch {torch.__version__}; {rounds} steps\n\nprocessor time "
        f"{spent / rounds:.2f} s, of which outside the network {outside / rounds:.3f} s "
        f"({outside / spent:.1%})"
    )


def print_peak(model: Path | None) -> None:
    """Evaluate once and print the peak memory in GB."""
    net = full_network(model)
    net(torch.randn(1, net.channels, 64, 1024), 0.5)
    scale = 1 if sys.platform == "darwin" else 1024
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * scale / 1e9)


def main(
    rounds: int = 7,
    threads: int = torch.get_num_threads(),
    model: Path | None = None,
    peak: bool = False,
    training: str = "",
    batch: int = 2,
) -> None:
    """Prints the tables."""
    torch.set_num_threads(1 if training else threads)
    if training:
        on_training(training, batch, rounds)
        return
    torch.set_grad_enabled(False)
    if peak:
        print_peak(model)
        return
    # First, because a child's peak starts with the memory of its parent.
    memory = peak_memory(model)
    net = full_network(model)
    on_cpu(net, rounds)
    weights = sum(values.nbytes for values in net.parameters()) / 1e9
    print(
        f"\nPeak memory of a process that does one evaluation: {memory:.2f} GB (weights: "
        f"{weights:.2f} GB)."
    )


if __name__ == "__main__":
    run(main)
