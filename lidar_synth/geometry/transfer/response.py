"""The response of a target sensor: which reflectance it gives where the recording sensor gave
another one."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.geometry.scan import Scan

QUANTILES = np.linspace(0, 1, 65)
NEAR = 4.0
FAR = 40.0
"""Metres between which returns are compared: sensors of different ranges both see them."""


@dataclass(frozen=True)
class Response:
    """A monotone curve from the reflectance of one sensor to that of another.

    Args:
        given: K reflectances of the recording sensor in [0, 1], increasing.
        gives: K reflectances of the target sensor in [0, 1], not decreasing.

    Raises:
        ConfigError: on other curves.
    """

    given: tuple[float, ...]
    gives: tuple[float, ...]

    def __post_init__(self) -> None:
        given = np.array(self.given)
        gives = np.array(self.gives)
        valid = given.shape == gives.shape and given.ndim == 1 and len(given) >= 2
        if not (
            valid
            and (np.diff(given) > 0).all()
            and (np.diff(gives) >= 0).all()
            and 0 <= gives[0] <= gives[-1] <= 1
        ):
            raise ConfigError(
                f"a response of {len(self.given)} and {len(self.gives)} values",
                "two or more, increasing, and as many from 0 to 1 that do not decrease",
            )

    def __call__(self, reflectance: NDArray[np.floating]) -> NDArray[np.float64]:
        """The target's reflectances, of the same shape."""
        return np.asarray(np.interp(reflectance, self.given, self.gives), np.float64)

    @classmethod
    def match(cls, recorded: Iterable[Scan], target: Iterable[Scan]) -> "Response":
        """The curve that gives scans of one sensor the distribution of reflectance of the other, by
        quantiles.

        Neither needs labels, but both should show scenes of the same kind: the curve cannot tell a
        brighter street from a brighter sensor.

        Raises:
            DataError: on scans without returns between 4 and 40 m.
        """
        return cls(
            *_matched(
                _reflectances(recorded, "recorded"), _reflectances(target, "target")
            )
        )


def _matched(
    recorded: NDArray[np.float32], target: NDArray[np.float32]
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """The arguments of ``Response`` that match the quantiles of reflectances (N,) and (M,)."""
    given = np.quantile(recorded, QUANTILES)
    gives = np.quantile(target, QUANTILES)
    values, first = np.unique(given, return_index=True)
    if len(values) < 2:
        return (0.0, 1.0), (float(gives.mean()),) * 2
    # A value with several quantiles gets their mean.
    means = [part.mean() for part in np.split(gives, first[1:])]
    return tuple(map(float, values)), tuple(map(float, means))


def _reflectances(scans: Iterable[Scan], which: str) -> NDArray[np.float32]:
    parts = []
    for scan in scans:
        distance = np.linalg.norm(scan.points, axis=1)
        parts.append(scan.reflectance[(distance >= NEAR) & (distance <= FAR)])
    if not sum(map(len, parts)):
        raise DataError(
            f"no {which} return between {NEAR:g} and {FAR:g} m",
            "scans with returns, to match reflectance",
        )
    return np.concatenate(parts)
