"""Features of frozen CLIP in place of images: kept once, the same for the model, refused early."""

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from conftest import random_scan
from latent_runs import (  # noqa: F401 - fixtures
    SENSOR,
    call,
    one_thread,
    scans,
    write_config,
)
from test_ranks import HDIT
from torch import Tensor, nn

from lidar_synth.errors import FileError
from lidar_synth.formats import WRITERS, open_scans
from lidar_synth.generate.checkpoint import ENCODER
from lidar_synth.generate.conditions import CONDITIONS
from lidar_synth.generate.models.encoders.clip_views import (
    CLIP_VARIABLE,
    CLIP_WIDTH,
    load_frozen_clip,
)
from lidar_synth.geometry.scan import Scan
from lidar_synth.lab.train import Conditioning, Other, TrainConfig, cache_scans
from lidar_synth.lab.train.config import load_config
from lidar_synth.lab.train.runs import open_stage

CAMERA = {
    "kind": "camera",
    "encoder": "clip_views",
    "dropout": 0.2,
    "view_dropout": 0.5,
    "image": [40, 80],
    "arguments": {"views": 2, "channels": 8},
}


class Tower(nn.Module):
    """In place of CLIP's weights, which are not at hand: random ones that see left and right."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(1)
        self.layer = nn.Linear(3 * 8 * 8, CLIP_WIDTH)

    def forward(self, pixel_values: Tensor) -> Any:
        small = nn.functional.adaptive_avg_pool2d(pixel_values, 8).flatten(1)
        return SimpleNamespace(image_embeds=self.layer(small))


@pytest.fixture
def clip(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    def load(place: str, **options: Any) -> Tower:
        return Tower()

    made = SimpleNamespace(from_pretrained=load)
    holder = SimpleNamespace(CLIPVisionModelWithProjection=made)
    monkeypatch.setitem(sys.modules, "transformers", holder)
    monkeypatch.setenv(CLIP_VARIABLE, str(tmp_path))
    load_frozen_clip.cache_clear()
    yield
    load_frozen_clip.cache_clear()


@pytest.fixture
def kitti(tmp_path: Path) -> Path:
    folder = tmp_path / "kitti360"
    writer: Any = WRITERS["kitti360"](folder)
    for i in range(3):
        image = np.random.default_rng(i).integers(0, 256, (40, 80, 3), dtype=np.uint8)
        writer.write(random_scan(SENSOR, 400, i), i, image=image)
    writer.finish()
    return folder


def config(scans: Path, kitti: Path, folder: Path) -> Path:  # noqa: F811
    return write_config(
        scans,
        folder,
        "camera",
        network=HDIT,
        condition=CAMERA,
        steps=2,
        data={"path": str(kitti), "layout": "kitti360", "split": "all", "flip": True},
        channels=["range"],
        samples={"every": 8, "count": 2},
    )


def test_features_are_those_of_the_images_mirrored_blank_or_of_one_view(
    scans: Path,  # noqa: F811
    kitti: Path,
    tmp_path: Path,
    clip: None,
) -> None:
    stage = open_stage(load_config(TrainConfig, config(scans, kitti, tmp_path)))
    kept = stage.open_data()
    field = kept.cache.fields["camera"]
    assert (field.shape, field.dtype) == ((3, 2, 2, CLIP_WIDTH), np.float16)
    encoder: Any = stage.parts(stage.network)[ENCODER]
    shape = (3, *encoder.resolution)

    def read(i: int, scan: Scan) -> Any:
        return CONDITIONS["camera"].read(scan, SENSOR, shape, {})

    pixels = cache_scans(
        open_scans(kitti, layout="kitti360", split="all"),
        SENSOR,
        ["range"],
        progress=False,
        others={"camera": Other(shape, read)},
    )
    about = Conditioning("camera", 0.2, 0.5, 2)
    live = replace(kept, cache=pixels, conditioning=about)
    images = live(range(40)).cond
    features = kept(range(40)).cond
    assert images is not None and features is not None
    assert torch.allclose(encoder(features), encoder(images), atol=2e-3)
    # 3 scans, 2 sides, 2 sorts; blank
    assert len(encoder(features).unique(dim=0)) == 13


def test_a_camera_model_is_trained_and_shown_on_features(
    scans: Path,  # noqa: F811
    kitti: Path,
    tmp_path: Path,
    clip: None,
) -> None:
    call("train", config(scans, kitti, tmp_path))
    assert len(list((tmp_path / "camera" / "samples").iterdir())) == 1


def test_missing_clip_is_noticed_before_the_scans(
    scans: Path,  # noqa: F811
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv(CLIP_VARIABLE, raising=False)
    load_frozen_clip.cache_clear()
    with pytest.raises(FileError, match="LIDAR_SYNTH_CLIP is not set"):
        call("train", config(scans, tmp_path / "nowhere", tmp_path))
