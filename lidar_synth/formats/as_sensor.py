"""The scans of a source as another sensor would have recorded them, with what files need beside the scan."""

from dataclasses import dataclass, replace

from lidar_synth.errors import ConfigError
from lidar_synth.formats.calibration import Calibration
from lidar_synth.formats.source import ScanFiles
from lidar_synth.geometry.scan import Scan, Source
from lidar_synth.geometry.transfer import Mount, Transfer, Transferred
from lidar_synth.noise import keyed_rng

_SURFACE = 0.1  # metres that returns stick out of their box
_FLOOR = 0.1  # metres above a box's bottom, below which a return is the road's


@dataclass(frozen=True)
class AsSensor:
    """Reads scans of a source as scans of another sensor.

    Args:
        transfer: to that sensor.
        sweeps: number of scans before and after each scan, of the same sequence, whose surfaces fill what the scan
            itself does not show; they need poses.

    Raises:
        ConfigError: on a negative number of sweeps.
    """

    transfer: Transfer
    sweeps: int = 0

    def __post_init__(self) -> None:
        if self.sweeps < 0:
            raise ConfigError(f"{self.sweeps} sweeps", "a number of scans before and after each scan")

    def cast(self, scan: Scan, source: Source, index: int) -> Transferred:
        """The scan at ``index`` of a source, which has been read; its noise depends on the index.

        Boxes in which the other sensor has no return are left out.

        Raises:
            DataError, FileError: as ``Transfer.cast``; also if a neighbouring sweep cannot be read.
        """
        others = [source.load(i) if isinstance(source, ScanFiles) else source[i] for i in self._around(source, index)]
        cast, seen = self.transfer.cast(scan, keyed_rng(0, index), others)
        if cast.boxes is not None:
            held = cast.boxes.enlarged(_SURFACE).contain(cast.points, above_floor=_FLOOR + _SURFACE)
            cast.boxes = cast.boxes[held.any(axis=1)]
        return Transferred(cast, seen)

    def _around(self, source: Source, index: int) -> list[int]:
        """The scans of the same sequence around a scan, without it."""
        near = range(max(index - self.sweeps, 0), min(index + self.sweeps + 1, len(source)))
        return [i for i in near if i != index and _sequence(source, i) == _sequence(source, index)]

    def calibration(self, camera: Calibration | None) -> Calibration | None:
        """The camera as seen from the target's mount. The dataset's own matrices hold the recording sensor's."""
        if camera is None or not self.moves:
            return camera
        moved = camera.camera_from_sensor @ self.transfer.mount.matrix
        return replace(camera, camera_from_sensor=moved, matrices={})

    @property
    def moves(self) -> bool:
        """Whether the target stands elsewhere, so that poses and calibration change."""
        return self.transfer.mount != Mount()

    @property
    def identity(self) -> str:
        """A text of everything that determines the scans."""
        return f"{self.transfer.identity} {self.sweeps} sweeps"


def _sequence(source: Source, index: int) -> str:
    return source.ids[index].rpartition("/")[0] if isinstance(source, ScanFiles) else ""
