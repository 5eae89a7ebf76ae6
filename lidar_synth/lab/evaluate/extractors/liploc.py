"""LIP-Loc's encoder of range images (Puligilla et al., WACVW 2024,
https://github.com/Shubodh/lidar-image-pretrain-VPR) as R3DPA uses it for FLD: a network of timm on
an image of 224 x 224.
"""

from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lidar_synth.errors import ConfigError, LibraryError
from lidar_synth.geometry import Scan
from lidar_synth.lab.evaluate.extractors.archive import Archive, load_weights
from lidar_synth.lab.evaluate.extractors.inputs import preparation
from lidar_synth.lab.evaluate.extractors.per_scan import PerScan, some

SIZE = 224
"""Rows and columns of the network's input."""
PREFIX = "encoder_lidar.model."
"""Names of the encoder's weights in the archive."""
MEAN = (0.485, 0.456, 0.406)
DEVIATION = (0.229, 0.224, 0.225)


def picture(depth: Tensor) -> Tensor:
    """The network's input (3, 224, 224).

    Metres times 5.1 become bytes. As in LIP-Loc's code, a byte overflows: from 50.2 m on, ranges
    begin again at 0, and -1 (no return) becomes 251.

    Args:
        depth: (H, W) metres, -1 where there is no return.
    """
    grey = ((depth * 5.1).long() & 255).float() / 255
    resized = F.interpolate(
        grey[None, None], (SIZE, SIZE), mode="bilinear", antialias=True
    )[0]
    mean = torch.tensor(MEAN)[:, None, None]
    deviation = torch.tensor(DEVIATION)[:, None, None]
    return (resized - mean) / deviation


def _load_state(network: nn.Module, content: Any, where: str) -> None:
    """Load the part of a checkpoint of R3DPA that is the encoder of range images."""
    state = content.get("state_dict") if isinstance(content, dict) else None
    if isinstance(state, dict):
        # Averaging patches, timm normalises with a layer that LIP-Loc's weights lack; R3DPA leaves
        # it as it is made.
        made = {
            k: v for k, v in network.state_dict().items() if k.startswith("fc_norm.")
        }
        state = made | {
            k.removeprefix(PREFIX): v for k, v in state.items() if k.startswith(PREFIX)
        }
    load_weights(network, state, where, extra=True)


def load_liploc(path: Path, prepared: str) -> PerScan:
    """An extractor from R3DPA's archive, with ``config.yaml`` and ``model.ckpt``; see
    ``load_extractor``.

    Raises:
        LibraryError: without timm.
    """
    try:
        import timm
    except ImportError as error:
        raise LibraryError(
            "LIP-Loc's encoder needs timm", hint="pip install 'lidar_synth[metrics]'"
        ) from error
    except RuntimeError as error:  # of torchvision, which timm imports
        raise LibraryError(
            f"timm cannot be imported ({error})",
            hint="Install torchvision of the same build as torch.",
        ) from error
    archive = Archive(path, "R3DPA")
    name = archive.yaml("config.yaml").get("trained_image_model_name")
    if not isinstance(name, str) or not timm.is_model(name):
        raise ConfigError(
            f"{path}: config.yaml names the network {name!r}", "a network of timm"
        )
    network = timm.create_model(
        name, pretrained=False, num_classes=0, global_pool="avg"
    ).eval()
    _load_state(network, archive.weights("model.ckpt"), str(path / "model.ckpt"))
    inputs = preparation(prepared)

    def describe(scan: Scan, generated: bool) -> Tensor:
        depth = torch.from_numpy(inputs.image(scan, generated)[0])
        some(depth[depth > 0])
        return network(picture(depth)[None])[0]  # type: ignore[no-any-return]

    return PerScan(describe)
