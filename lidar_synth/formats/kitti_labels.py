"""KITTI's ``label_2`` files: boxes in the rectified camera frame, one object per line of text.

A line (https://www.cvlibs.net/datasets/kitti/eval_object.php, devkit's readme) is ``name truncation
occlusion alpha left top right bottom h w l x y z rotation_y``, with x, y, z the centre of the box's
*floor*. A ``Boxes`` holds the centre of gravity in the sensor frame and the yaw about its z axis.
The camera is tilted by about one degree relative to the sensor, so that the ends of a long box move
by some centimetres; conversion back is exact.
"""

from itertools import compress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import DataError, parsing
from lidar_synth.files.disk import read_text, write_file
from lidar_synth.formats.calibration import Calibration
from lidar_synth.geometry import FARTHEST, Boxes, wrap_angle
from lidar_synth.geometry.arrays import Float64Array

_STEPS = np.linspace(0, 1, 33)[:, None, None, None]  # along a line
_FIELDS = "15 fields: a name and 14 numbers"


def read_label_2(path: Path, camera: Calibration) -> Boxes:
    """The boxes of a label file in the sensor frame.

    Raises:
        FileError: if it cannot be read.
        DataError: on a line without 15 fields (16 with a score), or a value that no label has.
    """
    return decode_label_2(read_text(path), path, camera)


def decode_label_2(text: str, path: Path, camera: Calibration) -> Boxes:
    """``read_label_2`` for the text of the file ``path``.

    Raises:
        DataError: as ``read_label_2``.
    """
    rows = [line.split() for line in text.splitlines() if line.strip()]
    bad = [row for row in rows if len(row) not in (15, 16)]
    if bad:
        raise DataError(f"{path}: a line with {len(bad[0])} fields", _FIELDS)
    with parsing(path, _FIELDS):
        values = np.array([row[1:15] for row in rows], np.float64).reshape(-1, 14)
    names = [row[0] for row in rows]
    ignored = np.array([name == "DontCare" for name in names], bool)
    within = np.abs(values) <= FARTHEST  # NaN is not
    sizes = (values[:, 7:10] > 0).all(axis=1) | ignored
    sound = within.all(axis=1) & np.isin(values[:, 1], (-1, 0, 1, 2, 3)) & sizes
    if not sound.all():
        line = int(np.flatnonzero(~sound)[0])
        raise DataError(
            f"{path}: line {line + 1} has the values {values[line].tolist()}",
            "finite numbers, a size above 0 and an occlusion of 0 to 3",
        )
    truncation, occlusion, alpha, image_box, size, floor, turn = np.split(
        values, [1, 2, 3, 7, 10, 13], axis=1
    )
    keep = ~ignored
    return Boxes(
        boxes_from_camera(floor[keep], size[keep], turn[keep, 0], camera),
        tuple(compress(names, keep)),
        truncation=truncation[keep, 0],
        occlusion=occlusion[keep, 0],
        image_box=image_box[keep],
        alpha=alpha[keep, 0],
        dont_care=image_box[ignored],
    )


def boxes_from_camera(
    floor: Float64Array,
    size: Float64Array,
    rotation_y: Float64Array,
    camera: Calibration,
) -> NDArray[np.float32]:
    """(M, 7) boxes in the sensor frame; the inverse of ``boxes_to_camera``.

    Args:
        floor: (M, 3) centre of the box's floor in the rectified camera frame, metres.
        size: (M, 3) height, width, length, metres.
        rotation_y: (M,) rotation about the camera's y axis, radians.
        camera: the calibration.
    """
    height, width, length = size.T
    centre = floor - np.outer(height, (0, 0.5, 0))
    back = camera.sensor_from_camera
    ahead = (
        np.stack([np.cos(rotation_y), 0 * rotation_y, -np.sin(rotation_y)], -1)
        @ back[:3, :3].T
    )
    yaw = np.arctan2(ahead[:, 1], ahead[:, 0])
    return np.column_stack(
        [centre @ back[:3, :3].T + back[:3, 3], length, width, height, yaw]
    ).astype(np.float32)


def boxes_to_camera(
    values: NDArray[np.float32], camera: Calibration
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """``floor``, ``size`` and ``rotation_y`` of ``boxes_from_camera`` for (M, 7) boxes in the
    sensor frame."""
    values = values.astype(np.float64)
    length, width, height, yaw = values[:, 3:].T
    to = camera.camera_from_sensor
    centre = values[:, :3] @ to[:3, :3].T + to[:3, 3]
    ahead = np.stack([np.cos(yaw), np.sin(yaw), 0 * yaw], -1) @ to[:3, :3].T
    floor = centre + np.outer(height, (0, 0.5, 0))
    return (
        floor,
        np.stack([height, width, length], -1),
        np.arctan2(-ahead[:, 2], ahead[:, 0]),
    )


def write_label_2(path: Path, boxes: Boxes, camera: Calibration) -> None:
    """The inverse of ``read_label_2`` with KITTI's two decimals; ``KITTIObjectWriter`` defines
    which boxes are listed.

    An unknown occlusion is written as 0, since KITTI's evaluation ignores objects of 3. An unknown
    alpha is computed: rotation_y minus the direction of the box from the *sensor*. (The devkit says
    the camera, but KITTI's own files agree with the sensor, up to rounding.)

    Raises:
        FileError: if it cannot be written.
        DataError: on a name of several words, or a value that readers refuse.
    """
    image_box, truncation = in_image(boxes, camera)
    floor, size, rotation_y = boxes_to_camera(boxes.values, camera)
    seen = floor - camera.camera_from_sensor[:3, 3]
    alpha = np.where(
        boxes.alpha > -10,
        boxes.alpha,
        wrap_angle(rotation_y - np.arctan2(seen[:, 0], seen[:, 2])),
    )
    lines = []
    listed = np.flatnonzero((image_box >= 0).all(axis=1))
    names = [boxes.names[i] for i in listed]
    if any(name.split() != [name] or name == "DontCare" for name in names):
        raise DataError(
            f"{path}: boxes called {sorted(set(names))}",
            "names of one word, such as Person_sitting",
        )
    for i in listed:
        occlusion = max(boxes.occlusion[i], 0)
        row = (alpha[i], *image_box[i], *size[i], *floor[i], rotation_y[i])
        lines.append(
            f"{boxes.names[i]} {_two(truncation[i])} {occlusion} {' '.join(map(_two, row))}"
        )
    for rectangle in boxes.dont_care:
        lines.append(
            f"DontCare -1 -1 -10 {' '.join(map(_two, rectangle))} -1 -1 -1 -1000 -1000 -1000 -10"
        )
    text = "".join(line + "\n" for line in lines)
    decode_label_2(text, path, camera)
    write_file(path, text.encode())


def in_image(boxes: Boxes, camera: Calibration) -> tuple[Float64Array, Float64Array]:
    """(M, 4) image boxes and (M,) truncations; unknown ones are computed from the corners and,
    where the camera's plane cuts a box, the lines between them. They stay below 0 outside of the
    view."""
    image_box = boxes.image_box.astype(np.float64)
    truncation = boxes.truncation.astype(np.float64)
    unknown = np.flatnonzero((boxes.image_box < 0).any(axis=1))
    if camera.image_size is None:
        return image_box, truncation
    edge = np.array(camera.image_size, np.float64) - 1
    for i in unknown:
        corners = boxes[[i]].corners()[0]
        lines = corners + _STEPS * (corners[:, None] - corners)
        pixels, depth = camera.pixels(lines.reshape(-1, 3))
        pixels = pixels[depth > 0]
        if not len(pixels):
            continue
        low = pixels.min(axis=0)
        high = pixels.max(axis=0)
        seen_low = np.clip(low, 0, edge)
        seen_high = np.clip(high, 0, edge)
        if (seen_high > seen_low).all():
            image_box[i] = *seen_low, *seen_high
            truncation[i] = 1 - np.prod(seen_high - seen_low) / np.prod(high - low)
    return image_box, truncation


def _two(value: float) -> str:
    # + 0.0 turns the -0.0 of a small negative value into 0.0.
    return f"{round(float(value), 2) + 0.0:.2f}"
