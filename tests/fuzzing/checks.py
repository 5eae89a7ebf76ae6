"""What a result that was read has to be: whole, finite, of the declared types and within the
declared limits."""

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from functools import singledispatch
from typing import Any

import numpy as np
from torch import Tensor, nn

from lidar_synth.datasets.classes import IGNORE, NAMES
from lidar_synth.formats import Calibration
from lidar_synth.generate.checkpoint import Checkpoint, Header
from lidar_synth.geometry.scan import FARTHEST, REAL, SYNTHETIC, Boxes, RangeImage, Scan
from lidar_synth.geometry.sensor import Sensor
from lidar_synth.lab.town.skin.skin import SOFT, Dressed

FIELD_TYPES = {
    "reflectance": "f4",
    "label": "u1",
    "raw_label": "u4",
    "instance": "i4",
    "ring": "i2",
    "confidence": "f4",
    "time": "f4",
}

BOX_TYPES = {
    "values": "f4",
    "truncation": "f4",
    "occlusion": "i1",
    "image_box": "f4",
    "instance": "i4",
    "alpha": "f4",
    "dont_care": "f4",
}


@singledispatch
def flaws(value: Any) -> Iterator[str]:
    """What is wrong with a value that was read, one line each; nothing where it is sound."""
    yield f"a {type(value).__name__}, of which nothing is known"


@flaws.register(str)
@flaws.register(int)
@flaws.register(float)
@flaws.register(type(None))
def _(value: object) -> Iterator[str]:
    yield from ()


@flaws.register(dict)
def _(values: dict[Any, Any]) -> Iterator[str]:
    yield from flaws(list(values.values()))


@flaws.register(np.ndarray)
@flaws.register(Tensor)
def _(values: Any) -> Iterator[str]:
    array = np.asarray(values)
    if array.dtype.kind in "fc" and not np.isfinite(array).all():
        yield f"{array.dtype} of shape {array.shape} that are not finite"


@flaws.register
def _(network: nn.Module) -> Iterator[str]:
    yield from flaws(list(network.state_dict().values()))


@flaws.register
def _(dressed: Dressed) -> Iterator[str]:
    if (
        not (np.abs(dressed.shift) <= SOFT).all()
        or not ((dressed.reflectance >= 0) & (dressed.reflectance <= 1)).all()
    ):
        yield "returns with a skin that move too far, or of a reflectance outside [0, 1]"


@flaws.register(list)
@flaws.register(tuple)
def _(values: list[Any] | tuple[Any, ...]) -> Iterator[str]:
    for value in values:
        yield from flaws(value)


@flaws.register
def _(scan: Scan) -> Iterator[str]:
    points = scan.points
    if points.dtype != np.float32 or points.shape != (len(scan), 3) or not len(scan):
        yield f"points of {points.dtype}, {points.shape}"
    elif not np.abs(points).max() <= FARTHEST:
        yield f"points up to {np.abs(points).max()} m"
    yield from _field_flaws(scan.fields(), (len(scan),))
    if scan.pose is not None:
        yield from _transform_flaws("pose", scan.pose)
    if scan.boxes is not None:
        yield from flaws(scan.boxes)
    if scan.domain not in (REAL, SYNTHETIC) or not isinstance(scan.id, str):
        yield f"domain {scan.domain!r}, id {scan.id!r}"
    yield from flaws(scan.sensor)


@flaws.register
def _(image: RangeImage) -> Iterator[str]:
    yield from flaws(image.sensor)
    if image.range.dtype != np.float32 or image.range.shape != image.sensor.shape:
        yield f"range of {image.range.dtype}, {image.range.shape} for {image.sensor.shape}"
    elif not ((image.range >= 0) & (image.range <= FARTHEST)).all():
        yield f"ranges from {image.range.min()} to {image.range.max()}"
    yield from _field_flaws(image.channels, image.sensor.shape)


@flaws.register
def _(boxes: Boxes) -> Iterator[str]:
    for name, kind in BOX_TYPES.items():
        values = getattr(boxes, name)
        if values.dtype != np.dtype(kind) or not np.isfinite(values).all():
            yield f"boxes: {name} of {values.dtype}, or not finite"
        if name != "dont_care" and len(values) != len(boxes):
            yield f"boxes: {len(values)} {name} for {len(boxes)} boxes"
    if len(boxes.names) != len(boxes) or not all(
        isinstance(name, str) for name in boxes.names
    ):
        yield f"boxes: names {boxes.names[:4]}"
    if not (boxes.values[:, 3:6] > 0).all():
        yield "boxes without a size"


@flaws.register
def _(camera: Calibration) -> Iterator[str]:
    yield from _transform_flaws("camera_from_sensor", camera.camera_from_sensor)
    if not np.isfinite(camera.projection).all():
        yield "a projection that is not finite"
    if camera.image_size is not None and not all(
        isinstance(n, int) and 0 < n < 2**31 for n in camera.image_size
    ):
        yield f"an image of {camera.image_size} pixels"


@flaws.register
def _(sensor: Sensor) -> Iterator[str]:
    rows, columns = sensor.shape
    if not (type(rows) is int and type(columns) is int and rows > 0 and columns > 0):
        yield f"a sensor of {rows!r} x {columns!r}"
    if (
        sensor.edges.shape != (rows + 1,)
        or not np.isfinite(sensor.edges).all()
        or (np.diff(sensor.edges) > 0).any()
    ):
        yield f"a sensor with edges {sensor.edges[:4]}"
    if not 0 <= sensor.range_min < sensor.range_max <= 1e30:
        yield f"a sensor from {sensor.range_min} to {sensor.range_max} m"
    if Sensor.from_dict(sensor.to_dict()) != sensor:
        yield "a sensor that is another one when it is written"


@flaws.register
def _(checkpoint: Checkpoint) -> Iterator[str]:
    yield from flaws(checkpoint.header)
    for name, network in checkpoint.networks.items():
        for key, tensor in network.state_dict().items():
            if tensor.is_floating_point() and not bool(tensor.isfinite().all()):
                yield f"{name}.{key} is not finite"


@flaws.register
def _(header: Header) -> Iterator[str]:
    yield from flaws(header.sensor)
    if Header.from_dict(header.to_dict()) != header:
        yield "a header that is another one when it is written"
    if not np.isfinite(header.time_grid).all():
        yield f"time grid {header.time_grid}"


def _field_flaws(values: Mapping[str, Any], shape: tuple[int, ...]) -> Iterator[str]:
    for name, array in values.items():
        if array.shape != shape or array.dtype != FIELD_TYPES.get(name, array.dtype):
            yield f"{name} of {array.dtype}, {array.shape} for {shape}"
        elif (
            name in ("reflectance", "confidence")
            and not ((array >= 0) & (array <= 1)).all()
        ):
            yield f"{name} from {array.min()} to {array.max()}"
        elif name == "label" and not ((array < len(NAMES)) | (array == IGNORE)).all():
            yield f"labels {np.unique(array)[-4:]}"


def _transform_flaws(name: str, matrix: Any) -> Iterator[str]:
    """A rigid transform is finite, and its rotation is one."""
    if (
        matrix.shape != (4, 4)
        or matrix.dtype != np.float64
        or not np.isfinite(matrix).all()
    ):
        yield f"{name} of {matrix.dtype}, {matrix.shape}, or not finite"
    elif (
        np.abs(matrix[:3, :3] @ matrix[:3, :3].T - np.eye(3)).max() > 0.1
        or (matrix[3] != (0, 0, 0, 1)).any()
    ):
        yield f"{name} is not rigid: {matrix.tolist()}"


def fingerprint(value: Any) -> str:
    """The same text for equal results of reading, down to the last bit."""
    digest = hashlib.sha256()
    _add(digest, value)
    return digest.hexdigest()


def _add(digest: Any, value: Any) -> None:
    if isinstance(value, np.ndarray):
        digest.update(
            f"{value.dtype}{value.shape}".encode()
            + np.ascontiguousarray(value).tobytes()
        )
    elif isinstance(value, Tensor):
        _add(digest, value.numpy())
    elif isinstance(value, nn.Module):
        _add(digest, dict(value.state_dict()))
    elif is_dataclass(value):
        _add(
            digest, {field.name: getattr(value, field.name) for field in fields(value)}
        )
    elif isinstance(value, Mapping):
        _add(digest, list(value.items()))
    elif isinstance(value, list | tuple):
        digest.update(f"[{len(value)}".encode())
        for item in value:
            _add(digest, item)
    else:
        digest.update(repr(value).encode("utf-8", "backslashreplace"))
