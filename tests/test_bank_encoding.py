"""The bytes of a bank: encoded range images and HDF5 chunks decode to what was written, or are
refused."""

import zlib
from typing import Any

import h5py
import hypothesis.strategies as st
import numpy as np
import pytest
from banks import SENSOR, some_image, spoiled
from hypothesis import given, settings

from lidar_synth.bank import Encoding
from lidar_synth.bank.boxes import check_boxes, encode_boxes
from lidar_synth.bank.chunks import checksum, deflate, fletcher32, inflate
from lidar_synth.bank.encoding import LEVELS, TYPES
from lidar_synth.datasets.classes import IGNORE
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.geometry.projection import project, unproject
from lidar_synth.geometry.scan import Boxes, RangeImage
from lidar_synth.geometry.sensor import Sensor

ALL = ("reflectance", "label", "confidence")


# Encoding


def test_decoded_images_differ_by_at_most_half_a_step(sensor: Sensor) -> None:
    image = some_image(1, sensor)
    image.range[0, :4] = (
        sensor.range_min,
        sensor.range_max,
        max(sensor.range_min, 1e-6),
        sensor.range_max * (1 - 1e-7),
    )
    encoding = Encoding(sensor, ALL)
    decoded = encoding.decode(encoding.encode(image))
    assert np.abs(decoded.range - image.range).max() <= encoding.scale / 2 * 1.02
    assert np.array_equal(decoded.mask, image.mask)
    # Nothing leaves the sensor's limits.
    assert np.array_equal(project(unproject(decoded)).mask, image.mask)
    assert np.array_equal(decoded.label, image.label)
    for name, levels in LEVELS.items():
        assert (
            np.abs(decoded.channels[name] - image.channels[name]).max()
            <= 0.5001 / levels
        )


@settings(max_examples=50)
@given(seed=st.integers(0, 2**32 - 1), near=st.floats(0, 3), far=st.floats(20, 300))
def test_encode_is_the_inverse_of_decode(seed: int, near: float, far: float) -> None:
    sensor = Sensor("any", 16, near, far, rows=4, fov_up=3.0, fov_down=-25.0)
    encoding = Encoding(sensor, ALL)
    rng = np.random.default_rng(seed)
    lowest = max(1, int(np.ceil(near * 1.000002 / encoding.scale)))
    arrays = {
        "range": rng.integers(lowest, 65536, sensor.shape).astype(np.uint16)
        * (rng.random(sensor.shape) < 0.8),
        "reflectance": rng.integers(0, 256, sensor.shape).astype(np.uint8),
        "label": rng.choice([*range(19), IGNORE], sensor.shape).astype(np.uint8),
        "confidence": rng.integers(0, 16, sensor.shape).astype(np.uint8),
    }
    again = encoding.encode(encoding.decode(arrays))
    for name, values in arrays.items():
        assert np.array_equal(again[name], values), name
        assert again[name].dtype == TYPES[name]


def test_codes_and_checksums_match_the_format() -> None:
    """Exact: a bank of today is read by every later version."""
    sensor = Sensor("x", 2, 0.0, 65.535, rows=2, fov_up=3.0, fov_down=-25.0)
    image = RangeImage(
        np.array([(0, 1e-9), (0.0015001, 65.535)], np.float32),
        sensor,
        {
            "reflectance": np.array([(0, 1), (0.5, 0.25)], np.float32),
            "label": np.array([(255, 0), (18, 7)], np.uint8),
            "confidence": np.array([(0, 1), (0.5, 0.1)], np.float32),
        },
    )
    arrays = Encoding(sensor, ALL).encode(image)
    assert {name: values.tolist() for name, values in arrays.items()} == {
        "range": [[0, 1], [2, 65535]],
        "reflectance": [[0, 255], [128, 64]],
        "label": [[255, 0], [18, 7]],
        "confidence": [[0, 15], [8, 2]],
    }
    assert Encoding(sensor).metres(
        np.array([0, 1, 1000], np.uint16)
    ).tolist() == pytest.approx([0, 0.001, 1.0])
    content = (
        "07000000000000000000000000010000",
        "000001000200ffff00ff8040ff001207000f0802",
    )
    expected = zlib.crc32(
        bytes.fromhex(content[0]) + b"seq/0001" + bytes.fromhex(content[1])
    )
    assert checksum(7, 2**40, arrays, b"seq/0001") == expected


BOX = np.array([[1.5, -2, -0.25, 4, 1e-5, 1.5, -1.25]], np.float32)


def test_codes_of_boxes_match_the_format() -> None:
    rows = encode_boxes(Boxes(BOX, ("Van",), instance=np.array([7])))
    assert rows.shape == (256, 9) and not rows[1:].any()
    expected = [2, 7, 15000, -20000, -2500, 40000, 1, 15000, -125000]
    assert rows[0].tolist() == expected
    check_boxes(rows)
    with pytest.raises(DataError, match="boxes without instance"):
        encode_boxes(Boxes(BOX, ("Van",)))


@pytest.mark.parametrize(
    ("row", "column", "code"),
    [
        *((0, 0, 12), (0, 0, -1), (0, 1, 0), (0, 5, 0), (0, 6, 0), (0, 7, -1)),
        *((1, 3, 5), (2, 0, 1)),
    ],
)
def test_codes_of_boxes_that_are_never_written_are_refused(
    row: int, column: int, code: int
) -> None:
    rows = encode_boxes(Boxes(BOX, ("Van",), instance=np.array([7])))
    rows[row, column] = code
    with pytest.raises(DataError, match="boxes with"):
        check_boxes(rows)


def test_encoding_into_existing_arrays() -> None:
    encoding = Encoding(SENSOR, ("label",))
    slots = {
        name: np.zeros((3, *shape), dtype)
        for name, (shape, dtype) in encoding.arrays().items()
    }
    encoding.encode(some_image(), {name: values[1] for name, values in slots.items()})
    for name, values in encoding.encode(some_image()).items():
        assert np.array_equal(slots[name][1], values)
        assert not slots[name][[0, 2]].any()


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (
            spoiled("range", 80.1),
            r"ranges from .* to 80\.1 m; expected 1\.45 to 80 m, the limits of 'small'",
        ),
        (spoiled("range", 1.4), r"ranges from 1\.4"),
        (spoiled("range", -1), "ranges from -1"),
        (spoiled("range", np.nan), "ranges from"),
        (spoiled("range", np.inf), "ranges from .* to inf"),
        (
            spoiled("reflectance", 1.01),
            r"reflectance from 0 to 1.01; expected values in \[0, 1\]",
        ),
        (spoiled("reflectance", np.nan), "reflectance from"),
        (spoiled("confidence", -0.1), "confidence from -0.1"),
        (spoiled("label", 19), r"train ids \[19\]; expected 0..18, or 255"),
        (
            RangeImage(some_image().range, SENSOR, {}),
            r"without \['reflectance', 'label', 'confidence'\]",
        ),
        (
            some_image(
                0, Sensor("other", 64, 1.45, 80.0, rows=8, fov_up=3.0, fov_down=-25.0)
            ),
            r"of \(8, 64\); expected",
        ),
    ],
)
def test_values_without_a_code_are_refused(image: RangeImage, message: str) -> None:
    with pytest.raises(DataError, match=message):
        Encoding(SENSOR, ALL).encode(image)


def test_unknown_fields_are_refused() -> None:
    with pytest.raises(
        ConfigError,
        match=r"fields \['ring'\] of a bank; expected some of range, reflectance",
    ):
        Encoding(SENSOR, ("label", "ring"))


# Chunks


@pytest.mark.parametrize("size", [1, 2, 3, 4, 719, 720, 721, 50_001])
@pytest.mark.parametrize("fill", [None, 0, 255])
def test_fletcher32_matches_hdf5(size: int, fill: int | None) -> None:
    data = (
        np.random.default_rng(size).integers(0, 256, size)
        if fill is None
        else np.full(size, fill)
    )
    with h5py.File("any", "w", driver="core", backing_store=False) as file:
        dataset = file.create_dataset(
            "x", data=data.astype(np.uint8), chunks=(size,), fletcher32=True
        )
        file.flush()
        chunk = bytes(dataset.id.read_direct_chunk((0,))[1])
    assert fletcher32(chunk[:-4]) == int.from_bytes(chunk[-4:], "little")


@given(
    values=st.integers(0, 2**32 - 1).map(np.random.default_rng),
    shape=st.tuples(st.integers(1, 9), st.integers(1, 700)),
    dtype=st.sampled_from([np.uint8, np.uint16, np.uint32]),
    most=st.sampled_from([1, 3, 256, 2**32 - 1]),
)
@settings(max_examples=60)
def test_inflate_is_the_inverse_of_deflate(
    values: np.random.Generator,
    shape: tuple[int, int],
    dtype: type[np.unsignedinteger[Any]],
    most: int,
) -> None:
    array = values.integers(0, min(most, np.iinfo(dtype).max), shape).astype(dtype)
    again = inflate(deflate(array), shape, np.dtype(dtype))
    assert again.dtype == dtype and np.array_equal(again, array)


def test_invalid_chunks_are_refused() -> None:
    array = np.random.default_rng(0).integers(0, 9, (8, 32)).astype(np.uint16)
    chunk = deflate(array)
    dtype = array.dtype
    for bit in range(8 * len(chunk)):
        damaged = bytearray(chunk)
        damaged[bit // 8] ^= 1 << bit % 8
        with pytest.raises(ValueError, match="Fletcher-32"):
            inflate(bytes(damaged), array.shape, dtype)
    for length in range(len(chunk)):
        with pytest.raises(ValueError):
            inflate(chunk[:length], array.shape, dtype)

    def sealed(packed: bytes) -> bytes:
        return packed + fletcher32(packed).to_bytes(4, "little")

    with pytest.raises(ValueError, match="does not hold 256 bytes"):
        inflate(chunk, array.shape, np.dtype(np.uint8))
    with pytest.raises(ValueError, match="it holds 512 bytes instead of 1024"):
        inflate(chunk, array.shape, np.dtype(np.uint32))
    for packed in (b"no zlib at all", chunk[:-9], zlib.compress(array.tobytes())[:40]):
        with pytest.raises(ValueError):
            inflate(sealed(packed), array.shape, dtype)
