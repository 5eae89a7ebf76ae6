"""Speed of the networks of LiDAR-Flow's latent models at full size, against a large matrix product.

    python tools/bench/latent.py [--rounds N] [--threads N] [--busy] [--width N]

LiDM's U-Net (257.8 M parameters, 171.7 GFLOP) on a latent of 8 x 16 x 128, its autoencoder (15.1 M;
93 GFLOP to encode and 120 to decode) at 64 x 1024, and the small ones of configs/town_*.yaml.
Random weights. All measurements take turns. With --busy, processor time replaces wall-clock time,
for a machine that does other work.
"""

import argparse
import time
from typing import Any

import torch
from timing import print_table, time_in_turns
from torch import nn

from lidar_synth.generate.loading import load_generator
from lidar_synth.generate.models import assemble, build_network


def network(architecture: str, **arguments: Any) -> Any:
    """A network with random weights, in the memory layout of a loaded checkpoint."""
    torch.manual_seed(0)
    fresh: nn.Module = build_network(architecture, arguments)
    return assemble(architecture, arguments, fresh.state_dict(), architecture)


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--busy", action="store_true", help="measure processor time")
    parser.add_argument(
        "--width",
        type=int,
        help="of narrow networks in place of LiDM's, to try the script",
    )
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    width = {"width": given.width} if given.width else {}
    full = network("unet", resolution=(16, 128), **width)
    codec = network("vqvae", resolution=(64, 1024), **width)
    shipped = load_generator("town")
    town = shipped.autoencoder
    town_flow = shipped.network
    a = torch.randn(4096, 4096)
    image = torch.randn(1, 1, 64, 1024)
    latent = torch.randn(1, 8, 16, 128)
    town_image = torch.randn(1, 7, *town.resolution)
    town_latent = torch.randn(1, *town.latent_shape)
    calls = {
        "product of 4096 x 4096 (137 GFLOP)": lambda: a @ a,
        "LiDM's U-Net, one evaluation": lambda: full(latent, 0.5),
        "LiDM's autoencoder, encode": lambda: codec.encode(image),
        "LiDM's autoencoder, decode": lambda: codec.decode(latent),
        "town's HDiT, one evaluation": lambda: town_flow(town_latent, 0.5),
        "town's autoencoder, encode": lambda: town.encode(town_image),
        "town's autoencoder, decode": lambda: town.decode(town_latent),
    }
    with torch.inference_mode():
        seconds = time_in_turns(
            calls, given.rounds, time.process_time if given.busy else time.perf_counter
        )
    what = "processor time" if given.busy else "wall time"
    title = (
        f"Latent models on the CPU, {given.threads} threads, float32, batch 1, {what}; torch "
        f"{torch.__version__}"
    )
    print_table(title, seconds, next(iter(calls)))


if __name__ == "__main__":
    main()
