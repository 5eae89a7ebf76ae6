"""Encoders of conditions: what a user gives becomes maps beside the state, or tokens that the state attends to.

They take conditions as they are stored (whole numbers) and train together with the velocity network; only CLIP's
vision tower is frozen, and it is no part of a checkpoint. ``argument`` names the argument of the velocity network that
takes their ``channels``.
"""

import os
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lidar_synth.datasets.classes import IGNORE, NAMES
from lidar_synth.errors import ConfigError, FileError, LibraryError
from lidar_synth.models.convolution import check_shape, pair, reduced

METHODS = ("rescale", "patches")
"""How a label map comes to the grid of the state: LiDM's bilinear halvings, or a learned matrix over each patch."""

CLIP_VARIABLE = "LIDAR_SYNTH_CLIP"
"""Environment variable: where CLIP ViT-L/14's weights lie."""
CLIP_WIDTH, CLIP_SIDE = 768, 224
_CLIP_MEAN, _CLIP_STD = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)


class SemanticMapEncoder(nn.Module):
    """A label map as maps on the grid of the state.

    Args:
        resolution: H, W of the label map.
        target: h, w of the state; they divide H and W, for "rescale" into powers of two.
        channels: of the maps.
        method: one of ``METHODS``. "rescale" is LiDM's: the one-hot classes are halved bilinearly, the columns at
            every halving, the rows at the last ones, and mixed by a 1 x 1 convolution. It looks at a few cells of
            each patch only; "patches" looks at all.

    Raises:
        ConfigError: on sizes that cannot be reached, or an unknown method.
    """

    argument = "condition_channels"

    def __init__(
        self, resolution: Sequence[int], target: Sequence[int], channels: int = 8, method: str = "rescale"
    ) -> None:
        super().__init__()
        self.resolution, self.channels, self.method = pair(resolution), channels, method
        target = pair(target)
        if method not in METHODS:
            raise ConfigError(f"method {method!r}", f"one of {', '.join(METHODS)}")
        patch = (max(1, self.resolution[0] // target[0]), max(1, self.resolution[1] // target[1]))
        if reduced(self.resolution, [patch], "a label map") != target:
            raise ConfigError(f"a label map of {self.resolution} for a state of {target}", "a multiple of its size")
        rows, columns = (p.bit_length() - 1 for p in patch)
        count = max(rows, columns)
        self.halvings = [(1 + (i >= count - rows), 1 + (i >= count - columns)) for i in range(count)]
        if method == "rescale" and patch != (1 << rows, 1 << columns):
            raise ConfigError(f"label maps of {self.resolution} rescaled to {target}", "powers of two between them")
        kernel = patch if method == "patches" else (1, 1)
        self.mix = nn.Conv2d(len(NAMES) + 1, channels, kernel, kernel, bias=False)

    def forward(self, labels: Tensor) -> Tensor:
        """(B, H, W) uint8 train ids, 255 = ignore, to (B, channels, h, w).

        Raises:
            DataError: on another size.
        """
        check_shape(labels, self.resolution, "a label map")
        code = torch.where(labels == IGNORE, len(NAMES), labels.long())
        x = F.one_hot(code, len(NAMES) + 1).movedim(-1, 1).to(self.mix.weight.dtype)  # channels last in memory
        if self.method == "rescale":
            for rows, columns in self.halvings:
                x = F.interpolate(x, scale_factor=(1 / rows, 1 / columns), mode="bilinear", align_corners=True)
        out: Tensor = self.mix(x)
        return out


class ViewEncoder(nn.Module):
    """A camera image, cut into views side by side, as tokens; small, and trained with the velocity network.

    Args:
        resolution: h, w of the image; w is a multiple of 16 times the views, h of 16.
        views: how many side by side.
        channels: of a token.
        widths: channels of the convolutions, each of which halves rows and columns.
    """

    argument = "context_channels"

    def __init__(
        self,
        resolution: Sequence[int] = (96, 320),
        views: int = 4,
        channels: int = 128,
        widths: Sequence[int] = (32, 64, 96, 128),
    ) -> None:
        super().__init__()
        self.resolution, self.channels, self.views = pair(resolution), channels, views
        grid = reduced(self.resolution, [(1, views)] + [(2, 2)] * len(widths), f"an image of {views} views")
        inputs = [3, *widths[:-1]]
        self.body = nn.Sequential()
        for a, b in zip(inputs, widths, strict=True):
            self.body.extend([nn.Conv2d(a, b, 3, 2, 1, bias=False), nn.BatchNorm2d(b), nn.SiLU()])
        self.place = nn.Parameter(torch.empty(widths[-1], *grid))
        self.view_embedding = nn.Parameter(torch.empty(views, 1, widths[-1]))
        nn.init.trunc_normal_(self.place, std=0.02)
        nn.init.trunc_normal_(self.view_embedding, std=0.02)
        self.project = nn.Linear(widths[-1], channels)

    def forward(self, image: Tensor) -> Tensor:
        """(B, 3, h, w) uint8 to (B, tokens, channels).

        Raises:
            DataError: on another size.
        """
        check_shape(image, (3, *self.resolution), "a camera image")
        x = cut(image, self.views).to(self.project.weight.dtype) / 127.5 - 1
        x = self.body(x.contiguous(memory_format=torch.channels_last)) + self.place
        x = x.flatten(2).transpose(1, 2)  # (B views, N, C)
        x = x.reshape(-1, self.views, *x.shape[1:]) + self.view_embedding
        out: Tensor = self.project(x.flatten(1, 2))
        return out


class ClipViewEncoder(nn.Module):
    """A camera image as one token per view, by the frozen vision tower of CLIP ViT-L/14, as LiDM has it; unlike there,
    the embedding of the view and the projection are trained.

    Args:
        views: how many side by side; each is resized to 224 x 224.
        channels: of a token.
    """

    argument = "context_channels"

    def __init__(self, views: int = 4, channels: int = 512) -> None:
        super().__init__()
        self.resolution, self.channels, self.views = (CLIP_SIDE, CLIP_SIDE * views), channels, views
        self.view_embedding = nn.Parameter(torch.empty(views, CLIP_WIDTH))
        nn.init.normal_(self.view_embedding, std=CLIP_WIDTH**-0.5)
        self.project = nn.Linear(CLIP_WIDTH, channels)

    def forward(self, image: Tensor) -> Tensor:
        """(B, 3, 224, 224 views) uint8 to (B, views, channels).

        Raises:
            DataError: on another size.
            FileError, LibraryError: where CLIP or its weights are not there.
        """
        check_shape(image, (3, *self.resolution), "a camera image")
        with torch.no_grad():
            x = cut(image, self.views).float() / 255
            mean, std = (x.new_tensor(v).view(3, 1, 1) for v in (_CLIP_MEAN, _CLIP_STD))
            tower = frozen_clip(os.environ.get(CLIP_VARIABLE, ""), str(x.device))
            features = tower((x - mean) / std).reshape(-1, self.views, CLIP_WIDTH)
        out: Tensor = self.project(features.to(self.project.weight.dtype) + self.view_embedding)
        return out


def cut(image: Tensor, views: int) -> Tensor:
    """(B, 3, h, w) to (B views, 3, h, w / views): strips side by side, left to right."""
    batch, channels, rows, columns = image.shape
    return image.reshape(batch, channels, rows, views, columns // views).movedim(3, 1).flatten(0, 1)


class _Tower(nn.Module):
    """(B, 3, 224, 224) normalised images to (B, 768), whichever library holds the weights."""

    def __init__(self, model: Any, transformers: bool) -> None:
        super().__init__()
        self.model, self.transformers = model, transformers

    def forward(self, x: Tensor) -> Tensor:
        out = self.model(pixel_values=x).image_embeds if self.transformers else self.model.encode_image(x)
        return cast(Tensor, out)


@lru_cache(maxsize=1)
def frozen_clip(place: str, device: str) -> nn.Module:
    """CLIP's vision tower from files that are on this machine; nothing is ever downloaded.

    Args:
        place: a folder in the format of transformers, or a file of open_clip.
        device: where it shall be.

    Raises:
        FileError: where there is nothing.
        LibraryError: where the library that reads it is not installed.
    """
    path = Path(place)
    hint = (
        f"Save CLIP ViT-L/14 as a folder (transformers: openai/clip-vit-large-patch14) or as open_clip's .safetensors "
        f"file, and set {CLIP_VARIABLE} to it; or train with the encoder 'views', which needs neither."
    )
    if not place or not path.exists():
        given = f"{CLIP_VARIABLE}={place}" if place else f"{CLIP_VARIABLE} is not set"
        raise FileError(f"CLIP's weights: {given}", "an existing folder or file", hint)
    try:
        if path.is_dir():
            from transformers import CLIPVisionModelWithProjection

            model = CLIPVisionModelWithProjection.from_pretrained(place, local_files_only=True, use_safetensors=True)
        elif path.suffix == ".safetensors":
            import open_clip

            model = open_clip.create_model("ViT-L-14-quickgelu", pretrained=place)
        else:
            raise FileError(f"CLIP's weights in {path}", "a folder, or a .safetensors file", hint)
    except ImportError as error:
        library = "transformers" if path.is_dir() else "open_clip_torch"
        raise LibraryError(f"{library} is not installed", library, f"pip install {library}") from error
    except OSError as error:
        raise FileError(f"CLIP's weights in {path} cannot be read ({error})", "a whole copy", hint) from error
    return _Tower(model, path.is_dir()).to(device).eval().requires_grad_(False)
