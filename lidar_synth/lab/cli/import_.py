"""``lidar-synth import``: converts the released weights of another project to a checkpoint of this
package."""

from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from lidar_synth.errors import ConfigError, choose


def import_(
    file: Annotated[
        Path, Argument(metavar="FILE", help="released weights: .pth or .ckpt")
    ],
    out: Annotated[
        Path, Argument(metavar="OUT.safetensors", help="checkpoint to write")
    ],
    peer: Annotated[
        str, Option(help="project of the weights: r2flow | lidm | r2dm")
    ] = "r2flow",
    check: Annotated[
        bool,
        Option("--check", help="generate scans in ten steps, and look at them"),
    ] = False,
    condition: Annotated[
        str | None,
        Option(help="dataset whose labels or images --check takes"),
    ] = None,
) -> None:
    """Converts the released weights of another project to a checkpoint.

    Reading the file runs no code from it. Parameter names, sign and time convention are converted;
    a file with missing or unexpected keys is refused, and the message lists them.

    With --check, four scans are generated: the share of cells with a return, a histogram of ranges
    and a picture beside the checkpoint show whether weights and conventions fit.

    \b
    Examples:
      lidar-synth import r2flow-kitti360-1rf.pth r2flow-1rf.safetensors
      lidar-synth import r2flow-kitti360-1rf.pth r2flow-1rf.safetensors --check
      lidar-synth sample scans --model r2flow-1rf.safetensors --count 16 --steps 32
      lidar-synth import lidm/uncond/model.ckpt lidm.safetensors --peer lidm
          (config.yaml beside model.ckpt)
      lidar-synth import diffusion_0000300000.pth r2dm.safetensors --peer r2dm
    """
    from lidar_synth.generate.checkpoint import VELOCITY, save_checkpoint
    from lidar_synth.lab.importers import IMPORTERS
    from lidar_synth.lab.importers.check import check_model

    load = choose("--peer", peer, IMPORTERS)
    if condition is not None and not check:
        raise ConfigError(f"--condition {condition} without --check", "--check as well")
    header, networks = load(file)
    if check and VELOCITY not in networks:
        raise ConfigError(
            f"--check of {file}, an autoencoder",
            "weights that generate scans",
            "Leave out --check.",
        )
    digest = save_checkpoint(out, header, networks)
    counts = [
        f"{n} {sum(p.numel() for p in net.parameters()) / 1e6:.1f} M parameters"
        for n, net in networks.items()
    ]
    rows, columns = header.sensor.shape
    print(
        f"{out}: {', '.join(counts)}, {rows} x {columns}, {', '.join(header.channels)}"
    )
    print(
        f"hash {digest}; weights {header.provenance['licence']}; data {header.provenance['data']}, "
        f"{header.provenance['data_licence']}"
    )
    if check:
        print(check_model(out, condition))
