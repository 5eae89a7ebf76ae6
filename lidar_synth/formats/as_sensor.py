"""The scans of a source as another sensor would have recorded them, with what files need beside the
scan."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lidar_synth.errors import ConfigError, DataError, check_count
from lidar_synth.formats.calibration import Calibration
from lidar_synth.formats.source import ScanFiles
from lidar_synth.geometry import Scan, Sensor, Source, load_sensor
from lidar_synth.geometry.transfer import (
    Measurement,
    Mount,
    Response,
    Transfer,
    Transferred,
)
from lidar_synth.noise import keyed_rng


@dataclass(frozen=True)
class AsSensor:
    """Reads scans of a source as scans of another sensor.

    Args:
        transfer: to that sensor.
        sweeps: number of scans before and after each scan, of the same sequence, whose surfaces
            fill what the scan itself does not show; they need poses.

    Raises:
        ConfigError: on a negative number of sweeps.
    """

    transfer: Transfer
    sweeps: int = 0

    def __post_init__(self) -> None:
        check_count("sweeps", self.sweeps, 0)

    def cast(self, scan: Scan, source: Source, index: int) -> Transferred:
        """The scan at ``index`` of a source, which has been read; its noise depends on the index.

        Raises:
            DataError, FileError: as ``Transfer.cast``; also if a neighbouring sweep cannot be read,
                unless the source skips it.
        """
        others = _read(source, self._around(source, index))
        return self.transfer.cast(scan, keyed_rng(0, index), others)

    def _around(self, source: Source, index: int) -> list[int]:
        """The scans of the same sequence around a scan, without it."""
        near = range(
            max(index - self.sweeps, 0), min(index + self.sweeps + 1, len(source))
        )
        return [
            i
            for i in near
            if i != index and _sequence(source, i) == _sequence(source, index)
        ]

    def calibration(self, camera: Calibration | None) -> Calibration | None:
        """The camera as seen from the target's mount. The dataset's own matrices hold the recording
        sensor's."""
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


def _read(source: Any, numbers: Iterable[int]) -> list[Scan]:
    """The scans of a source by number, without those that it skips."""
    if not isinstance(source, ScanFiles):
        return [source[i] for i in numbers]
    return source.load_readable(numbers)


def _sequence(source: Source, index: int) -> str:
    return source.ids[index].rpartition("/")[0] if isinstance(source, ScanFiles) else ""


def make_transfer(
    sensor: str | Sensor,
    mount: tuple[float, float],
    like: str | Path | Source | None,
    scans: Any,
    **measured: Any,
) -> Transfer:
    """The transfer of scans to a sensor.

    Args:
        sensor: as ``load_sensor`` takes it.
        mount: metres higher, degrees looking further down.
        like: real scans of that sensor, or their folder in any layout, whose distribution of
            reflectance the transfer gives.
        scans: the scans that will be turned: by index, or of a generator.
        measured: other arguments of ``Measurement``.

    Raises:
        ConfigError, FileError, DataError: on a sensor, a mount or scans that there cannot be.
    """
    target = load_sensor(sensor)
    response = None
    if like is not None:
        response = Response.match(_some(scans), _real(like, target))
    return Transfer(target, Mount(*mount), Measurement(**measured, response=response))


def read_transfer(given: Any, scans: Any) -> Any:
    """What the setting ``as_sensor`` of a configuration stands for.

    Args:
        given: ``{"sensor": NAME, "mount": [Z, PITCH], "like": FOLDER}``, of which only the sensor
            is required; anything else is returned unchanged.
        scans: as in ``make_transfer``.

    Raises:
        ConfigError: on other keys or values.
        FileError, DataError: as ``make_transfer``.
    """
    if not isinstance(given, Mapping):
        return given
    values = {"mount": (0.0, 0.0), "like": None} | {
        str(key).lower(): value for key, value in given.items()
    }
    mount = values["mount"]
    numbers = isinstance(mount, list | tuple) and [
        type(v) in (int, float) for v in mount
    ] == [True, True]
    if (
        values.keys() != {"sensor", "mount", "like"}
        or not isinstance(values["sensor"], str)
        or not numbers
    ):
        raise ConfigError(
            f"as_sensor: {dict(given)}",
            "sensor: a preset's name or a YAML file; optionally mount: [metres higher, degrees "
            "down], like: a folder of real scans",
        )
    return make_transfer(values["sensor"], tuple(mount), values["like"], scans)


def _real(like: str | Path | Source, target: Sensor) -> list[Scan]:
    """Some of the real scans of a sensor; an error for a folder that needs options says what to
    do."""
    from lidar_synth.formats import open_scans

    if not isinstance(like, str | Path):
        return _some(like)
    source = open_scans(like, sensor=target)
    try:
        return _some(source)
    except DataError as error:
        raise DataError(
            f"--like {like} (like=...), which is read without further options",
            "scans that need none",
            f"Convert them first, with those that they need: lidar-synth convert {like} OUT --to "
            f"npz --sensor {target.name}; then give OUT. {error}",
        ) from error


def _some(scans: Any) -> list[Scan]:
    """Ten scans spread over a source; the first four of a generator or an endless source."""
    if hasattr(scans, "range_images"):
        scans = scans.as_synthetic()
    if getattr(scans, "length", 0) is None:
        return _read(scans, range(4))
    numbers = sorted({round(k * (len(scans) - 1) / 9) for k in range(10)})
    return _read(scans, numbers)
