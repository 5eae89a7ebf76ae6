"""The place of the target sensor on the vehicle, relative to the sensor that recorded the scan."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import ConfigError
from lidar_synth.geometry.scan import Boxes

Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class Mount:
    """The place of the target sensor relative to the sensor that recorded the scan.

    Args:
        z: metres above the recording sensor.
        pitch: degrees by which the target's x axis points down.

    Raises:
        ConfigError: on more than 5 m or 45 degrees.

    Example:
        >>> import numpy as np
        >>> from lidar_synth.geometry.transfer import Mount
        >>> Mount(z=0.1).points(np.array([(10.0, 0.0, -1.7)]))  # the road is further below
        array([[10. ,  0. , -1.8]])
    """

    z: float = 0.0
    pitch: float = 0.0

    def __post_init__(self) -> None:
        if not (abs(self.z) <= 5 and abs(self.pitch) <= 45):
            raise ConfigError(
                f"a mount {self.z} m higher, pitched by {self.pitch} degrees",
                "at most 5 m, 45 degrees",
            )

    @property
    def matrix(self) -> Matrix:
        """(4, 4) from the target's frame to the frame of the recording sensor."""
        c = np.cos(np.radians(self.pitch))
        s = np.sin(np.radians(self.pitch))
        return np.array(
            [(c, 0, s, 0), (0, 1, 0, 0), (-s, 0, c, self.z), (0, 0, 0, 1)], np.float64
        )

    def points(self, points: NDArray[np.floating]) -> Matrix:
        """(N, 3) points of the recording sensor's frame in the target's frame, metres."""
        if self == Mount():
            return points.astype(np.float64)
        turned = points.astype(np.float64) @ self.matrix[:3, :3]
        turned -= self.matrix[:3, 3] @ self.matrix[:3, :3]
        return turned

    def boxes(self, boxes: Boxes) -> Boxes:
        """Boxes of the recording sensor's frame in the target's frame.

        Boxes have a yaw only: with a pitch, sizes stay, and a box no longer contains exactly the
        same points. What concerns the camera stays, because the camera does not move with the
        sensor.
        """
        if self == Mount():
            return boxes
        values = boxes.values.astype(np.float64)
        heading = (
            np.stack(
                [np.cos(values[:, 6]), np.sin(values[:, 6]), np.zeros(len(boxes))], 1
            )
            @ self.matrix[:3, :3]
        )
        values[:, :3] = self.points(values[:, :3])
        values[:, 6] = np.arctan2(heading[:, 1], heading[:, 0])
        return replace(boxes, values=values.astype(np.float32))
