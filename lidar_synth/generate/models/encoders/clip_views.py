"""Encoder of camera images by CLIP's vision tower, which is frozen and not part of a checkpoint."""

import os
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar, cast

import torch
from torch import Tensor, nn

from lidar_synth.errors import FileError, LibraryError
from lidar_synth.generate.models.convolution import check_shape
from lidar_synth.generate.models.encoders.camera_views import split_views
from lidar_synth.generate.models.layers import normal_values
from lidar_synth.generate.models.network import Encoder

CLIP_VARIABLE = "LIDAR_SYNTH_CLIP"
"""Environment variable with the path of CLIP ViT-L/14's weights."""
CLIP_WIDTH = 768
CLIP_SIDE = 224
_CLIP_MEAN = (0.48145466, 0.4578275, 0.40821073)
_CLIP_STD = (0.26862954, 0.26130258, 0.27577711)


class ClipViewEncoder(Encoder):
    """Encodes a camera image as one token per view with the frozen vision tower of CLIP ViT-L/14,
    as in LiDM. Unlike in LiDM, the view embedding and the projection are trained.

    Args:
        views: number of views side by side, each of 224 x 224 pixels.
        channels: channels of a token.
    """

    condition: ClassVar[str] = "camera"
    argument: ClassVar[str] = "context_channels"

    def __init__(self, views: int = 4, channels: int = 512) -> None:
        super().__init__()
        self.resolution = (CLIP_SIDE, CLIP_SIDE * views)
        self.channels = channels
        self.views = views
        start = normal_values(views, CLIP_WIDTH, std=CLIP_WIDTH**-0.5)
        self.view_embedding = nn.Parameter(start)
        self.project = nn.Linear(CLIP_WIDTH, channels)

    def forward(self, cond: Tensor) -> Tensor:
        """Images (B, 3, 224, 224 views) uint8, or their features by ``look``, to (B, views,
        channels); raises as ``look``."""
        features = cond if cond.shape[1:] == self.seen else self.look(cond)
        out: Tensor = self.project(
            features.to(self.project.weight.dtype) + self.view_embedding
        )
        return out

    @property
    def seen(self) -> tuple[int, int]:
        """Views and channels of what ``look`` returns for an image."""
        return self.views, CLIP_WIDTH

    @torch.no_grad()
    def look(self, image: Tensor) -> Tensor:
        """(B, 3, 224, 224 views) uint8 to CLIP's features (B, views, 768), which never change.

        Raises:
            DataError: on another size.
            FileError, LibraryError: if CLIP or its weights are missing.
        """
        check_shape(image, (3, *self.resolution), "a camera image")
        x = split_views(image, self.views).float() / 255
        mean, std = (x.new_tensor(v).view(3, 1, 1) for v in (_CLIP_MEAN, _CLIP_STD))
        out: Tensor = find_clip(x.device)((x - mean) / std)
        return out.reshape(-1, *self.seen)


class _Tower(nn.Module):
    """(B, 3, 224, 224) normalised images to (B, 768), with the weights of either library."""

    def __init__(self, model: Any, transformers: bool) -> None:
        super().__init__()
        self.model = model
        self.transformers = transformers

    def forward(self, x: Tensor) -> Tensor:
        out = (
            self.model(pixel_values=x).image_embeds
            if self.transformers
            else self.model.encode_image(x)
        )
        return cast(Tensor, out)


def find_clip(device: torch.device | str) -> nn.Module:
    """The tower that the environment names; raises as ``load_frozen_clip``."""
    place = torch.empty(0, device=device).device  # "cuda:0" for "cuda"
    return load_frozen_clip(os.environ.get(CLIP_VARIABLE, ""), str(place))


@lru_cache(maxsize=1)
def load_frozen_clip(location: str, device: str) -> nn.Module:
    """Load CLIP's vision tower from local files; nothing is ever downloaded.

    Args:
        location: a folder in the format of transformers, or a ``.safetensors`` file of open_clip.
        device: the device of the weights.

    Raises:
        FileError: if the files are missing or cannot be read.
        LibraryError: if the library that reads them is not installed.
    """
    path = Path(location)
    hint = (
        "Save CLIP ViT-L/14 as a folder (transformers: openai/clip-vit-large-patch14) or as "
        f"open_clip's .safetensors file, and set {CLIP_VARIABLE} to it; or train with the encoder "
        "'views', which needs neither."
    )
    if not location or not path.exists():
        given = (
            f"{CLIP_VARIABLE}={location}" if location else f"{CLIP_VARIABLE} is not set"
        )
        raise FileError(f"CLIP's weights: {given}", "an existing folder or file", hint)
    try:
        if path.is_dir():
            from transformers import CLIPVisionModelWithProjection

            model = CLIPVisionModelWithProjection.from_pretrained(
                location, local_files_only=True, use_safetensors=True
            )
        elif path.suffix == ".safetensors":
            import open_clip

            model = open_clip.create_model("ViT-L-14-quickgelu", pretrained=location)
        else:
            raise FileError(
                f"CLIP's weights in {path}", "a folder, or a .safetensors file", hint
            )
    except ImportError as error:
        library = "transformers" if path.is_dir() else "open_clip_torch"
        raise LibraryError(
            f"{library} is not installed", library, f"pip install {library}"
        ) from error
    except OSError as error:
        raise FileError(
            f"CLIP's weights in {path} cannot be read ({error})",
            "a complete copy",
            hint,
        ) from error
    return _Tower(model, path.is_dir()).to(device).eval().requires_grad_(False)
