"""Encoding of range images: 3 to 5 bytes per cell, the same bytes on every machine.

=========== ====== ==================================================================
array       type   value
=========== ====== ==================================================================
range       uint16 metres = value * scale, scale = the sensor's range_max / 65535
                   (1.2 mm for 80 m); 0 = no return
reflectance uint8  value / 255
label       uint8  train ids 0..18, 255 = ignore
confidence  uint8  value / 15: four bits are precise enough for a confidence
instance    uint16 the instance of the point's box; 0 = none
boxes       int32  (256, 9) for each scan, see ``boxes``
=========== ====== ==================================================================

``encode`` rounds by at most half a step, and ``encode(decode(x)) == x``. Every return stays a
return: a range below half a step is stored as 1, not as 0, and decoded ranges stay within the
sensor's limits, so that a projection keeps them.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from lidar_synth.bank.boxes import SHAPE, check_boxes, decode_boxes, encode_boxes
from lidar_synth.datasets.classes import IGNORE, NAMES
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.geometry import RangeImage, Sensor

_compiled = numba.njit(nogil=True, cache=True)

RANGE_STEPS = 65535
"""Steps of the range from 0 to the sensor's range_max."""

TYPES: dict[str, type[np.integer[Any]]] = {
    "range": np.uint16,
    "reflectance": np.uint8,
    "label": np.uint8,
    "confidence": np.uint8,
    "instance": np.uint16,
    "boxes": np.int32,
}
"""Arrays and their types, in the order in which they are stored."""

LEVELS = {"reflectance": 255, "confidence": 15}
"""Steps from 0 to 1."""

_INSIDE = 1e-6
"""Relative margin between decoded ranges and the sensor's limits: the rounding error of float32
points."""


class Encoding:
    """Encodes range images of one sensor as compact arrays and decodes them.

    Args:
        sensor: defines the grid.
        fields: names of ``TYPES`` that are stored beside the range.

    Attributes:
        names: the names of the arrays, in order.
        scale: metres per step of the range.

    Raises:
        ConfigError: on a field that has no encoding.
    """

    def __init__(self, sensor: Sensor, fields: Iterable[str] = ()) -> None:
        given = {"range", *fields}
        if unknown := sorted(given - set(TYPES)):
            raise ConfigError(
                f"fields {unknown} of a bank", f"some of {', '.join(TYPES)}"
            )
        self.sensor = sensor
        self.names = tuple(name for name in TYPES if name in given)
        self.scale = sensor.range_max / RANGE_STEPS

    def arrays(self) -> dict[str, tuple[tuple[int, int], np.dtype[Any]]]:
        """Shape and type of each array of one scan."""
        return {
            name: (
                SHAPE if name == "boxes" else self.sensor.shape,
                np.dtype(TYPES[name]).newbyteorder("<"),
            )
            for name in self.names
        }

    def encode(
        self, image: RangeImage, out: Mapping[str, NDArray[Any]] | None = None
    ) -> dict[str, NDArray[Any]]:
        """The arrays of a range image.

        Args:
            image: on the sensor's grid, with a channel (or boxes) for each field; further channels
                are ignored.
            out: arrays to write into, with the types of ``arrays``; new ones by default.

        Returns:
            {name: array}: ``out`` if given, otherwise new arrays.

        Raises:
            DataError: on another grid, a missing channel, or a value that has no code: a range
                outside the sensor's limits, a reflectance or confidence outside [0, 1], an unknown
                train id or class of a box, NaN.
        """
        if image.sensor.shape != self.sensor.shape:
            raise DataError(
                f"a range image of {image.sensor.shape}",
                f"{self.sensor.shape} of {self.sensor.name!r}",
            )
        own = {"range": image.range, "boxes": image.boxes}
        given: dict[str, Any] = {**image.channels, **own}
        if missing := [name for name in self.names if given.get(name) is None]:
            raise DataError(
                f"a range image without {missing}", f"channels {list(self.names[1:])}"
            )
        codes = {
            n: encode_boxes(given[n]) if n == "boxes" else self._code(n, given[n])
            for n in self.names
        }
        if out is None:
            return codes
        for name, code in codes.items():
            np.copyto(out[name], code)
        return {name: out[name] for name in self.names}

    def decode(self, arrays: Mapping[str, NDArray[Any]]) -> RangeImage:
        """The range image of encoded arrays, in new memory; float32 except for the labels."""
        channels: dict[str, NDArray[Any]] = {}
        for name in (n for n in self.names[1:] if n != "boxes"):
            if name in LEVELS:
                channels[name] = np.empty(self.sensor.shape, np.float32)
                _decode_shares(
                    arrays[name].ravel(),
                    np.float32(LEVELS[name]),
                    channels[name].reshape(-1),
                )
            else:
                channels[name] = arrays[name].astype(
                    np.int32 if name == "instance" else np.uint8
                )
        boxes = decode_boxes(arrays["boxes"]) if "boxes" in self.names else None
        return RangeImage(self.metres(arrays["range"]), self.sensor, channels, boxes)

    def check(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Refuse codes that ``encode`` never writes.

        Raises:
            DataError: naming the array.
        """
        for name in set(LEVELS) & set(arrays):
            if LEVELS[name] < arrays[name].max(initial=0):
                raise DataError(
                    f"a {name} with the code {arrays[name].max()}",
                    f"at most {LEVELS[name]}",
                )
        if "label" in arrays:
            _train_ids(arrays["label"])
        if "boxes" in arrays:
            check_boxes(arrays["boxes"])

    def metres(self, codes: NDArray[np.uint16]) -> NDArray[np.float32]:
        """Ranges in metres (any shape) from their codes; 0 = no return."""
        near = self.sensor.range_min * (1 + _INSIDE)
        far = self.sensor.range_max * (1 - _INSIDE)
        metres = np.empty(codes.shape, np.float32)
        _decode_range(
            codes.ravel(),
            np.float32(self.scale),
            np.float32(near),
            np.float32(far),
            metres.reshape(-1),
        )
        return metres

    def _code(self, name: str, values: NDArray[Any]) -> NDArray[Any]:
        """The codes of one channel."""
        if name == "label":
            return _train_ids(values)
        if name == "instance":
            if values.min(initial=0) < 0 or values.max(initial=0) > 65535:
                raise DataError(
                    f"instances from {values.min()} to {values.max()}", "0..65535"
                )
            return values.astype(np.uint16)
        if name == "range":
            return self._code_ranges(values)
        codes = np.empty(values.shape, TYPES[name])
        if not _encode_shares(
            values.ravel(), np.float32(LEVELS[name]), codes.reshape(-1)
        ):
            raise DataError(
                f"{name} from {values.min():g} to {values.max():g}", "values in [0, 1]"
            )
        return codes

    def _code_ranges(self, metres: NDArray[Any]) -> NDArray[Any]:
        """The inverse of ``metres``."""
        codes = np.empty(metres.shape, np.uint16)
        near = self.sensor.range_min - self.scale / 2
        far = self.sensor.range_max + self.scale / 2
        limits = np.float32(max(near, 0)), np.float32(far)
        if not _encode_range(
            metres.ravel(), np.float32(1 / self.scale), *limits, codes.reshape(-1)
        ):
            returns = metres[metres != 0]
            raise DataError(
                f"a range image with ranges from {returns.min():g} to {returns.max():g} m",
                f"{self.sensor.range_min:g} to {self.sensor.range_max:g} m, the limits of "
                f"{self.sensor.name!r}, or 0 = no return",
            )
        return codes


def _train_ids(label: NDArray[Any]) -> NDArray[np.uint8]:
    wrong = (label >= len(NAMES)) & (label != IGNORE)
    if wrong.any():
        raise DataError(
            f"train ids {np.unique(label[wrong]).tolist()[:8]}",
            f"0..{len(NAMES) - 1}, or {IGNORE} = ignore",
        )
    return label.astype(np.uint8)


@_compiled
def _encode_range(metres, inverse, near, far, out):  # type: ignore[no-untyped-def]
    """Steps of 1 / inverse metres, of (N,) float32; False where a range is outside near to far and
    not 0."""
    sound = True
    for i in range(len(metres)):
        seen = metres[i] != 0
        sound &= ((metres[i] >= near) & (metres[i] <= far)) | (not seen)
        out[i] = np.uint16(
            min(
                max(np.rint(metres[i] * inverse), np.float32(seen)),
                np.float32(RANGE_STEPS),
            )
        )
    return sound


@_compiled
def _decode_range(codes, scale, near, far, out):  # type: ignore[no-untyped-def]
    """The inverse of ``_encode_range``, clipped to near..far."""
    for i in range(len(codes)):
        out[i] = (
            min(max(np.float32(codes[i]) * scale, near), far)
            if codes[i] > 0
            else np.float32(0)
        )


@_compiled
def _encode_shares(values, levels, out):  # type: ignore[no-untyped-def]
    """Steps of 1 / levels; False where a value is outside 0 to 1."""
    sound = True
    for i in range(len(values)):
        sound &= (values[i] >= 0) & (values[i] <= 1)
        out[i] = np.uint8(np.rint(np.float32(values[i]) * levels))
    return sound


@_compiled
def _decode_shares(codes, levels, out):  # type: ignore[no-untyped-def]
    """The inverse of ``_encode_shares``."""
    for i in range(len(codes)):
        out[i] = np.float32(codes[i]) / levels
