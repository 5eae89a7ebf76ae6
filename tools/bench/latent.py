"""Speed of the networks of LiDAR-Flow's latent models at full size, against a large matrix product.

    python tools/bench/latent.py [--rounds N] [--threads N] [--busy] [--width N]

LiDM's U-Net (257.8 M parameters, 171.7 GFLOP) on a latent of 8 x 16 x 128, its autoencoder (15.1 M;
93 GFLOP to encode and 120 to decode) at 64 x 1024, and the small ones of configs/town_*.yaml.
Random weights. All measurements take turns. With --busy, processor time replaces wall-clock time,
for a machine that does other work.
"""

from collections.abc import Callable
from typing import Any

import torch
from timing import CLOCKS, print_table, time_in_turns
from torch import nn
from typer import run

from lidar_synth.generate.loading import load_generator
from lidar_synth.generate.models import assemble, build_network


def network(architecture: str, **arguments: Any) -> Any:
    """A network with random weights, in the memory layout of a loaded checkpoint."""
    torch.manual_seed(0)
    fresh: nn.Module = build_network(architecture, arguments)
    return assemble(architecture, arguments, fresh.state_dict(), architecture)


def calls(**width: int) -> dict[str, Callable[[], object]]:
    """What is measured, the product first."""
    full = network("unet", resolution=(16, 128), **width)
    codec = network("vqvae", resolution=(64, 1024), **width)
    shipped = load_generator("town")
    town = shipped.autoencoder
    a = torch.randn(4096, 4096)
    image = torch.randn(1, 1, 64, 1024)
    latent = torch.randn(1, 8, 16, 128)
    town_image = torch.randn(1, 7, *town.resolution)
    town_latent = torch.randn(1, *town.latent_shape)
    return {
        "product of 4096 x 4096 (137 GFLOP)": lambda: a @ a,
        "LiDM's U-Net, one evaluation": lambda: full(latent, 0.5),
        "LiDM's autoencoder, encode": lambda: codec.encode(image),
        "LiDM's autoencoder, decode": lambda: codec.decode(latent),
        "town's HDiT, one evaluation": lambda: shipped.network(town_latent, 0.5),
        "town's autoencoder, encode": lambda: town.encode(town_image),
        "town's autoencoder, decode": lambda: town.decode(town_latent),
    }


def main(
    rounds: int = 5,
    threads: int = torch.get_num_threads(),
    busy: bool = False,
    width: int | None = None,
) -> None:
    """Prints the table."""
    torch.set_num_threads(threads)
    what, clock = CLOCKS[busy]
    with torch.inference_mode():
        given = calls(width=width) if width else calls()
        seconds = time_in_turns(given, rounds, clock)
    title = (
        f"Latent models on the CPU, {threads} threads, float32, batch 1, {what}; torch "
        f"{torch.__version__}"
    )
    print_table(title, seconds, next(iter(seconds)))


if __name__ == "__main__":
    run(main)
