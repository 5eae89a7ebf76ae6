"""Encoding and decoding of ranges, reflectance and labels."""

import math
from typing import Any

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from conftest import random_scan
from hypothesis import given
from hypothesis.extra import numpy as hnp

from lidar_synth.datasets.classes import IGNORE
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.generate.models import network_class
from lidar_synth.geometry.normalize import (
    CHANNELS,
    NORMALISATIONS,
    Normalisation,
    TensorFormat,
    decode_labels,
    decode_reflectance,
    encode_labels,
    encode_reflectance,
)
from lidar_synth.geometry.projection import project
from lidar_synth.geometry.sensor import presets


@pytest.mark.parametrize("name", sorted(NORMALISATIONS))
@given(distances=hnp.arrays(np.float32, 40, elements=st.floats(0, 100, width=32)))
def test_decode_inverts_encode_inside_the_limits_and_drops_the_rest(
    name: str, distances: np.ndarray
) -> None:
    scale = NORMALISATIONS[name]
    d = torch.from_numpy(distances)
    x = scale.encode(d)
    assert x.abs().max() <= 1
    near_limit = (d / scale.range_min - 1).abs().minimum(
        (d / scale.range_max - 1).abs()
    ) < 1e-5
    expected = torch.where(scale.inside(d), d, 0)
    assert torch.allclose(
        scale.decode(x)[~near_limit], expected[~near_limit], rtol=2e-5
    )
    assert Normalisation(**scale.to_dict()) == scale


def test_no_return_is_encoded_as_minus_one_and_the_farthest_return_as_one() -> None:
    scale = NORMALISATIONS["r2flow"]
    x = scale.encode(torch.tensor([0.0, 79.9999, 1.45, 80.0]))
    assert x.tolist() == [-1, pytest.approx(1, abs=1e-6), -1, -1]
    # 80 m is outside.
    assert scale.decode(torch.tensor([-3.0, -1.0, 1.0, 3.0])).tolist() == [
        0,
        0,
        0,
        0,
    ]


def test_reflectance_is_decoded_and_clamped() -> None:
    r = torch.linspace(0, 1, 11)
    assert torch.allclose(decode_reflectance(encode_reflectance(r)), r, atol=1e-7)
    assert decode_reflectance(torch.tensor([-2.0, 2.0])).tolist() == [0, 1]


@given(noise=st.floats(-0.45, 0.45), seed=st.integers(0, 100))
def test_labels_are_decoded_correctly_under_noise_below_half_a_bit(
    noise: float, seed: int
) -> None:
    label = (
        torch.cat([torch.arange(19), torch.tensor([IGNORE])])
        .to(torch.uint8)
        .view(1, 4, 5)
    )
    bits = encode_labels(label)
    signs = (
        torch.randint(0, 2, bits.shape, generator=torch.Generator().manual_seed(seed))
        * 2
        - 1
    )
    decoded, confidence = decode_labels(bits + noise * signs)
    assert torch.equal(decoded, label)
    assert torch.allclose(
        confidence, torch.full_like(confidence, 1 - abs(noise)), atol=1e-6
    )


def test_labels_have_five_bits_highest_first_and_unlabelled_is_19() -> None:
    bits = encode_labels(torch.tensor([[[0, 18, IGNORE]]], dtype=torch.uint8))
    assert bits[0, :, 0].T.tolist() == [[-1] * 5, [1, -1, -1, 1, -1], [1, -1, -1, 1, 1]]
    assert decode_labels(torch.zeros(1, 5, 1, 1))[1].item() == 0
    # 31 is no class; 15 is one bit away
    label, confidence = decode_labels(torch.ones(1, 5, 1, 1))
    assert (label.item(), confidence.item()) == (15, 0)


def test_invalid_input_is_refused() -> None:
    with pytest.raises(DataError, match=r"train ids \[20\]"):
        encode_labels(torch.full((1, 2, 2), 20, dtype=torch.uint8))
    with pytest.raises(ConfigError, match="log, linear or inverse"):
        Normalisation("cubic", 1, 2)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="range_min < range_max"):
        Normalisation("log", 5, 2)


@pytest.mark.parametrize(
    "channels", [("range",), ("reflectance", "range"), tuple(CHANNELS)]
)
def test_a_range_image_is_unchanged_by_encoding_and_decoding(
    channels: tuple[str, ...],
) -> None:
    sensor = presets()["town"]
    image = project(random_scan(sensor))
    tensors = TensorFormat(channels, NORMALISATIONS["r2flow"])
    x = tensors.from_images([image, image])
    assert x.shape == (2, tensors.size, 64, 1024)
    assert x.abs().max() <= 1
    back = tensors.to_images(x, sensor)[1]
    assert np.allclose(back.range, image.range, rtol=2e-5)
    for name in set(channels) - {"range"}:
        assert np.allclose(back.channels[name], image.channels[name], atol=1e-6), name
    assert set(back.channels) == set(channels) - {"range"} | (
        {"confidence"} if "label" in channels else set()
    )
    if "label" in channels:
        assert np.array_equal(back.channels["confidence"], image.mask)


def test_a_cell_without_a_return_has_no_label_reflectance_or_confidence() -> None:
    tensors = TensorFormat(("range", "reflectance", "label"), NORMALISATIONS["r2flow"])
    x = tensors.encode(
        {
            "range": torch.full((1, 1, 2), 9.0),
            "reflectance": torch.full((1, 1, 2), 0.7),
            "label": torch.full((1, 1, 2), 3, dtype=torch.uint8),
        }
    )
    x[:, 0, 0, 1] = -0.9  # nearer than 1.45 m
    fields = tensors.decode(x)
    assert fields["label"].tolist() == [[[3, IGNORE]]]
    assert fields["confidence"].tolist() == [[[1, 0]]]
    assert fields["reflectance"].tolist() == [[[pytest.approx(0.7), 0]]]


def test_invalid_tensors_and_formats_are_refused() -> None:
    tensors = TensorFormat(("range", "reflectance"), NORMALISATIONS["r2flow"])
    with pytest.raises(
        DataError, match=r"shape \(1, 3, 4, 4\); expected \(B, 2, H, W\)"
    ):
        tensors.decode(torch.zeros(1, 3, 4, 4))
    with pytest.raises(DataError, match="NaN or infinity"):
        tensors.decode(torch.full((1, 2, 4, 4), torch.nan))
    with pytest.raises(ConfigError, match=r"without \['reflectance'\]"):
        tensors.encode({"range": torch.zeros(1, 4, 4)})
    for channels in (("reflectance",), ("range", "colour"), ("range", "range")):
        with pytest.raises(ConfigError, match="range and some of"):
            TensorFormat(channels, NORMALISATIONS["r2flow"])


@pytest.mark.parametrize("key", ["range_min", "range_max", "scale", "offset"])
@pytest.mark.parametrize("value", ["x", math.nan, math.inf, -1.0, [1], 10**400, True])
def test_impossible_numbers_are_refused(key: str, value: Any) -> None:
    with pytest.raises(ConfigError):
        Normalisation(
            **({"kind": "log", "range_min": 1.0, "range_max": 80.0} | {key: value})
        )


def test_inverse_ranges_start_above_0() -> None:
    with pytest.raises(ConfigError, match="0 < range_min"):
        Normalisation("inverse", 0.0, 80.0)


@pytest.mark.parametrize("name", [["hdit"], {}, None, "x"])
def test_an_architecture_that_is_no_name_is_refused(name: Any) -> None:
    with pytest.raises(ConfigError, match="architecture"):
        network_class(name)
