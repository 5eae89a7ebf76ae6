"""Speed of the full HDiT (80.9 M parameters) at 64 x 1024, against a large matrix product.

    python tools/bench/networks.py [--rounds N] [--threads N] [--model FILE.safetensors]

On a CPU: seconds of one evaluation, its rate relative to the product's, a profile by kind of
    operation, peak memory. On
a GPU: scans per second by batch, latency of one scan, rate relative to the product's, the errors of
    bfloat16 and TF32.
Rates count the operations that the network needs, not those of an implementation. The weights are
random unless a checkpoint of the same size is given; errors in metres are meaningful only with
trained ones.
"""

import argparse
import resource
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import torch
from timing import machine
from torch import Tensor, nn
from torch.profiler import ProfilerActivity, profile
from tqdm import tqdm

from lidar_synth.generate.checkpoint import VELOCITY, load_checkpoint
from lidar_synth.generate.flow.solvers import solve
from lidar_synth.generate.models.hdit.hdit import HDiT
from lidar_synth.geometry.normalize import NORMALISATIONS
from lidar_synth.geometry.sensor import load_sensor

EVALUATION = 156.4e9
"""Floating point operations of one evaluation: 153.1e9 in linear layers, the rest in attention."""
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


def seconds(call: Callable[[], object], cuda: bool = False) -> float:
    """Wall time of one call."""
    start = time.perf_counter()
    call()
    if cuda:
        torch.cuda.synchronize()
    return time.perf_counter() - start


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
    rates = {
        name: 2 * 4096**3 / f(product) / 1e9
        for name, f in (("median", median), ("best", min))
    }
    print(
        f"| product of 4096 x 4096 | {median(product):.3f} ({min(product):.3f}) "
        f"| {rates['median']:.0f} ({rates['best']:.0f}) | 100 % |"
    )
    share = [
        EVALUATION / f(evaluation) / 1e9 / rates[name]
        for name, f in (("median", median), ("best", min))
    ]
    print(
        f"| HDiT, batch 1 | {median(evaluation):.3f} ({min(evaluation):.3f}) "
        f"| {EVALUATION / median(evaluation) / 1e9:.0f} ({EVALUATION / min(evaluation) / 1e9:.0f}) "
        f"| {share[0]:.0%} ({share[1]:.0%}) |"
    )
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


def on_cuda(net: nn.Module, rounds: int) -> None:
    """Print throughput and latency of 4 steps in bfloat16, then the errors of lower precision."""
    card = torch.cuda.get_device_name()
    a = torch.randn(8192, 8192, device="cuda", dtype=torch.bfloat16)
    a @ a
    rate = 2 * 8192**3 / min(seconds(lambda: a @ a, cuda=True) for _ in range(rounds))
    print(
        f"\n### 4-step scans on {card}, bfloat16, torch {torch.__version__}, "
        f"{time.strftime('%Y-%m-%d')}\n"
    )
    print(f"product of 8192 x 8192: {rate / 1e12:.0f} TFLOP/s\n")
    print(
        "| batch | eager: scans/s | compiled: scans/s | latency, ms | share of the product's rate "
        "| memory, GB |"
    )
    print("|---:|---:|---:|---:|---:|---:|")
    half = full_network(None).cuda()
    half.load_state_dict(net.state_dict())
    half.to(torch.bfloat16)
    for batch in (1, 4, 16, 64):
        noise = torch.randn(batch, 2, 64, 1024, device="cuda")
        torch.compiler.reset()
        torch.cuda.reset_peak_memory_stats()
        # CUDA graphs: kernels are not launched singly.
        fast = torch.compile(half, mode="reduce-overhead")
        times = []
        for velocity in (half, fast):
            for _ in range(3):
                solve(velocity, noise, GRID)
            torch.cuda.synchronize()
            times.append(
                median(
                    seconds(lambda v=velocity, y=noise: solve(v, y, GRID), True)
                    for _ in range(rounds)
                )
            )
        share = 4 * EVALUATION * batch / min(times) / rate
        memory = torch.cuda.max_memory_allocated() / 1e9
        print(
            f"| {batch} | {batch / times[0]:.0f} | {batch / times[1]:.0f} | {1e3 * min(times):.1f} "
            f"| {share:.0%} | {memory:.1f} |"
        )
    precision(net.cuda(), half)


def precision(net: nn.Module, half: nn.Module) -> None:
    """Print the differences of scans from those in float32, from the same noise."""
    noise = torch.randn(4, 2, 64, 1024, device="cuda")
    scans = {}
    torch.backends.cuda.matmul.allow_tf32 = False
    exact = solve(net, noise, GRID)
    scans["bfloat16"] = solve(half, noise, GRID)
    torch.backends.cuda.matmul.allow_tf32 = True
    scans["TF32"] = solve(net, noise, GRID)
    print(
        "\n| precision | relative l2 | median of differences in range, m | 99 %, m "
        "|\n|---|---:|---:|---:|"
    )
    decode = NORMALISATIONS["r2flow"].decode
    for name, scan in scans.items():
        metres = (decode(scan[:, 0]) - decode(exact[:, 0])).abs().flatten()
        print(
            f"| {name} | {float((scan - exact).norm() / exact.norm()):.1e} | "
            f"{float(metres.median()):.4f} | {float(metres[: 1 << 24].quantile(0.99)):.4f} |"
        )


def main() -> None:
    """Prints the tables for the devices of this machine."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument(
        "--model", type=Path, help="a checkpoint with a network of this size"
    )
    parser.add_argument(
        "--peak",
        action="store_true",
        help="evaluate once and print the peak memory in GB",
    )
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    torch.set_grad_enabled(False)
    if options.peak:
        net = full_network(options.model)
        net(torch.randn(1, net.channels, 64, 1024), 0.5)
        scale = 1 if sys.platform == "darwin" else 1024
        print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * scale / 1e9)
        return
    # First, because a child's peak starts with the memory of its parent.
    peak = peak_memory(options.model)
    net = full_network(options.model)
    on_cpu(net, options.rounds)
    weights = sum(values.nbytes for values in net.parameters()) / 1e9
    print(
        f"\nPeak memory of a process that does one evaluation: {peak:.2f} GB (weights: "
        f"{weights:.2f} GB)."
    )
    if torch.cuda.is_available():
        on_cuda(net, options.rounds)


if __name__ == "__main__":
    main()
