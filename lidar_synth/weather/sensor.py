"""Failures of the sensor as the Robo3D benchmark (Kong et al., ICCV 2023) defines them,
and ``LowPower``, which it does not have."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import TRAIN_ID
from lidar_synth.errors import DataError
from lidar_synth.geometry import Scan
from lidar_synth.weather.corruption import (
    CROSSTALK,
    Change,
    Corruption,
    keep_points,
    require_between,
    rings_of,
)
from lidar_synth.weather.signal import SignalLoss, ranges_of

VEHICLES = [
    TRAIN_ID[name]
    for name in ("car", "bicycle", "motorcycle", "truck", "other-vehicle")
]


@dataclass(frozen=True)
class MotionBlur(Corruption):
    """A vibrating vehicle: every point is displaced horizontally.

    Args:
        spread: standard deviation of x and of y, metres.

    Raises:
        ConfigError: on a spread outside 0 to 1 m.

    Example:
        >>> import numpy as np
        >>> from lidar_synth import Town
        >>> from lidar_synth.weather import MotionBlur
        >>> scan = Town(seed=0, scans=1)[0]
        >>> blurred = MotionBlur(spread=0.08)(scan, np.random.default_rng(0))
        >>> (blurred.points - scan.points).std(axis=0).round(2)
        array([0.08, 0.08, 0.  ], dtype=float32)
    """

    spread: float
    name = "motion_blur"
    SEVERE = {"spread": 0.04}, {"spread": 0.08}, {"spread": 0.10}

    def __post_init__(self) -> None:
        require_between("spread", self.spread, 0, 1)

    def change(self, scan: Scan, rng: np.random.Generator) -> Change:
        same = keep_points(scan, np.ones(len(scan), bool))
        noise = rng.standard_normal((len(scan), 2), np.float32)
        points = same.points.copy()
        points[:, :2] += np.float32(self.spread) * noise
        return Change(same.source, points, same.reflectance, same.cause)


@dataclass(frozen=True)
class MissingBeams(Corruption):
    """Beams that fail: all returns of some of them are lost.

    Args:
        share: of the sensor's beams, in [0, 1].

    Raises:
        ConfigError: on another share.

    Example:
        >>> import numpy as np
        >>> from lidar_synth import Town
        >>> from lidar_synth.weather import MissingBeams
        >>> scan = Town(seed=0, scans=1)[0]
        >>> half = MissingBeams(share=0.5)(scan, np.random.default_rng(0))
        >>> len(np.unique(half.ring)) == len(np.unique(scan.ring)) // 2
        True
    """

    share: float
    name = "missing_beams"
    # As 16, 32 and 48 failures among 64 beams, where a beam may be drawn more than once.
    SEVERE = {"share": 0.223}, {"share": 0.396}, {"share": 0.53}

    def __post_init__(self) -> None:
        require_between("share", self.share, 0, 1)

    def change(self, scan: Scan, rng: np.random.Generator) -> Change:
        rows = scan.sensor.shape[0]
        lost = rng.choice(rows, round(self.share * rows), replace=False)
        return keep_points(scan, ~np.isin(rings_of(scan), lost))


@dataclass(frozen=True)
class CrossSensor(Corruption):
    """A sensor with fewer beams, and fewer returns along each: evenly spaced ones stay.

    Args:
        share: share of the beams that stay, in (0, 1].
        along: share of the returns of a beam that stay, in (0, 1].

    Raises:
        ConfigError: on other shares.

    Example:
        >>> import numpy as np
        >>> from lidar_synth import Town
        >>> from lidar_synth.weather import CrossSensor
        >>> scan = Town(seed=0, scans=1)[0]
        >>> few = CrossSensor(share=0.25)(scan, np.random.default_rng(0))
        >>> len(np.unique(few.ring)) <= 16
        True
    """

    share: float
    along: float = 1.0
    name = "cross_sensor"
    SEVERE = tuple({"share": share, "along": 0.5} for share in (0.75, 0.5, 0.25))

    def __post_init__(self) -> None:
        require_between("share", self.share, 1e-3, 1)
        require_between("along", self.along, 1e-3, 1)

    def change(self, scan: Scan, rng: np.random.Generator) -> Change:
        rings = rings_of(scan)
        stay = _stays(rings, self.share)
        if self.along < 1:
            stay &= _stays(_number_along(rings, scan.points), self.along)
        return keep_points(scan, stay)


@dataclass(frozen=True)
class Crosstalk(Corruption):
    """Pulses of other beams or sensors: some points are displaced at random.

    Args:
        share: of the points, in [0, 1].
        spread: standard deviation of each coordinate, metres.

    Raises:
        ConfigError: on another share, or a spread outside 0 to 100 m.

    Example:
        >>> import numpy as np
        >>> from lidar_synth import Town
        >>> from lidar_synth.weather import Crosstalk
        >>> scan = Town(seed=0, scans=1)[0]
        >>> noisy = Crosstalk(share=0.01)(scan, np.random.default_rng(0))
        >>> bool(0 < (noisy.label != scan.label).mean() <= 0.01)
        True
    """

    share: float
    spread: float = 3.0
    name = "crosstalk"
    SEVERE = {"share": 0.006}, {"share": 0.008}, {"share": 0.01}

    def __post_init__(self) -> None:
        require_between("share", self.share, 0, 1)
        require_between("spread", self.spread, 0, 100)

    def change(self, scan: Scan, rng: np.random.Generator) -> Change:
        same = keep_points(scan, np.ones(len(scan), bool))
        hit = rng.choice(len(scan), round(self.share * len(scan)), replace=False)
        points = same.points.copy()
        points[hit] += self.spread * rng.standard_normal((len(hit), 3), np.float32)
        cause = same.cause.copy()
        cause[hit] = CROSSTALK
        return Change(same.source, points, same.reflectance, cause)


@dataclass(frozen=True)
class IncompleteEcho(Corruption):
    """Dark vehicles: a share of their returns is lost.

    Args:
        share: of the returns of vehicles, in [0, 1].

    Raises:
        ConfigError: on another share.
        DataError: on a scan without labels.

    Example:
        >>> import numpy as np
        >>> from lidar_synth import Town
        >>> from lidar_synth.weather import IncompleteEcho
        >>> scan = Town(seed=0, scans=1)[0]
        >>> dark = IncompleteEcho(share=0.85)(scan, np.random.default_rng(0))
        >>> int((dark.label == 0).sum()) < 0.3 * int((scan.label == 0).sum())
        True
    """

    share: float
    name = "incomplete_echo"
    SEVERE = {"share": 0.75}, {"share": 0.85}, {"share": 0.95}

    def __post_init__(self) -> None:
        require_between("share", self.share, 0, 1)

    def change(self, scan: Scan, rng: np.random.Generator) -> Change:
        if scan.label is None:
            raise DataError(
                f"scan {scan.id!r} without labels",
                "labels, which say what is a vehicle",
            )
        lost = np.isin(scan.label, VEHICLES) & (rng.random(len(scan)) < self.share)
        return keep_points(scan, ~lost)


@dataclass(frozen=True)
class LowPower(SignalLoss):
    """A laser that has lost power: weak returns are not detected.

    Args:
        power: share of the power that is left, in (0, 1].

    Raises:
        ConfigError: on another power.

    Example:
        >>> import numpy as np
        >>> from lidar_synth import Town
        >>> from lidar_synth.weather import LowPower
        >>> scan = Town(seed=0, scans=1)[0]
        >>> weak = LowPower(power=0.25)(scan, np.random.default_rng(0))
        >>> len(weak) < len(scan)
        True
    """

    power: float
    name = "low_power"
    SEVERE = {"power": 0.5}, {"power": 0.25}, {"power": 0.1}

    def __post_init__(self) -> None:
        require_between("power", self.power, 1e-3, 1)

    def change(self, scan: Scan, rng: np.random.Generator) -> Change:
        return self.attenuate(scan, ranges_of(scan), self.power, rng)


def _number_along(
    rings: NDArray[np.int64], points: NDArray[np.float32]
) -> NDArray[np.int64]:
    """(N,) the number of each point, counted along one beam after the other."""
    turn = np.arctan2(points[:, 1], points[:, 0]) * np.float32(32_767 / np.pi)
    # Stable sorts of 16 bits are by far the fastest.
    order = np.argsort(turn.astype(np.int16), kind="stable")
    order = order[np.argsort(rings[order].astype(np.int16), kind="stable")]
    number = np.empty(len(points), np.int64)
    number[order] = np.arange(len(points))
    return number


def _stays(number: NDArray[np.int64], share: float) -> NDArray[np.bool_]:
    """Whether each of some beams or returns is among those that stay, evenly spaced."""
    stays: NDArray[np.bool_] = np.floor((number + 1) * share) > np.floor(number * share)
    return stays
