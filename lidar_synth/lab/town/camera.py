"""The town's camera: its calibration and the rays of its pixels.

The camera is mounted 0.8 m in front of the LiDAR and 0.3 m to its left; it points straight ahead
and five degrees down. Focal length, principal point and image size are those of KITTI-360's
rectified image_00.
"""

import numpy as np
from numpy.typing import NDArray

from lidar_synth.formats.calibration import AXES_CAMERA_FROM_SENSOR, Calibration
from lidar_synth.lab.town.scene import Pose

_PITCH = np.radians(5.0)
_PLACE = (0.80, 0.30, -0.18)


def _calibration() -> Calibration:
    """The calibration from the position, pitch and intrinsics of the camera."""
    c = np.cos(_PITCH)
    s = np.sin(_PITCH)
    level = np.eye(4)
    level[:3, 3] = np.negative(_PLACE)
    down = np.array(
        [
            (c, 0, -s, 0),
            (0, 1, 0, 0),
            (s, 0, c, 0),
            (0, 0, 0, 1),
        ]
    )
    projection = np.array(
        [(552.554261, 0, 682.049453, 0), (0, 552.554261, 238.769549, 0), (0, 0, 1, 0)]
    )
    return Calibration(projection, AXES_CAMERA_FROM_SENSOR @ down @ level, (1408, 376))


CAMERA = _calibration()
"""The calibration of the town's camera."""


def pixel_rays(
    pose: Pose, pixels: NDArray[np.floating]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The position of the camera and the directions of its pixels in the world frame.

    Args:
        pose: (4, 4) sensor to world.
        pixels: (N, 2) column and row; integers are pixel centres.

    Returns:
        (3,) position of the camera in metres, and (N, 3) unit vectors.
    """
    camera = (pose @ CAMERA.sensor_from_camera).astype(np.float32)
    (fx, _, cx, _), (_, fy, cy, _), _ = CAMERA.projection.astype(np.float32)
    x = (pixels[:, 0].astype(np.float32) - cx) / fx
    y = (pixels[:, 1].astype(np.float32) - cy) / fy
    length = np.sqrt(x * x + y * y + 1)
    ahead = np.stack([x, y, np.ones_like(x)], 1) / length[:, None]
    return camera[:3, 3], ahead @ camera[:3, :3].T


def all_pixels() -> NDArray[np.float32]:
    """(H * W, 2) column and row of every pixel, row by row."""
    assert CAMERA.image_size is not None
    width, height = CAMERA.image_size
    grid = np.meshgrid(np.arange(width), np.arange(height))
    return np.stack(grid, -1).reshape(-1, 2).astype(np.float32)
