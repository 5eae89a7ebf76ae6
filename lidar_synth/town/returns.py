"""The sensor model: from ray hits to returns with range and reflectance, or to no return.

The model is fitted to labelled street scans of an HDL-64E. Reflectance is corrected for distance up to about 25 m and
then decreases; it hardly depends on the angle of incidence except near grazing incidence; glossy paint and glass
return light only at normal incidence; number plates and signs are retroreflectors; each laser has its own gain.
Rays are dropped at random, with a probability that grows as the returned signal falls.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidar_synth.geometry.sensor import Sensor
from lidar_synth.town.cast import MISS, Hits, Stage
from lidar_synth.town.materials import SurfaceTable, column

Floats = NDArray[np.float32]
LEVELS = 256
"""Reflectance is stored as k / 256, as KITTI-360 does."""

_THROUGH, _LOST, _SPECKLE = column("through"), column("lost"), column("speckle")
_GLOSS, _DEPTH = column("gloss"), column("depth")
_STEP = 0.25
_RANGES = np.array([0, 4, 8, 20, 25, 35, 50, 70, 130])
_FALL = np.interp(np.arange(0, 130, _STEP), _RANGES, [0.72, 0.82, 0.98, 0.98, 0.90, 0.64, 0.40, 0.22, 0.10]).astype(
    np.float32
)
"""Factor of reflectance by distance, in steps of ``_STEP`` metres."""
_DARK = 0.10
"""Values below this are reduced further, to 0 at two thirds of it: the sensor measures 0 for dark surfaces."""
_BLANK = 0.025
"""Share of returns whose reflectance is 0 at random."""


@dataclass(frozen=True)
class Noise:
    """The measurement noise of the sensor.

    Args:
        range_std: metres, standard deviation of the range.
        gain_std: standard deviation of the lasers' gains.
        threshold: signal strength at which half of the rays are dropped.
    """

    range_std: float = 0.018
    gain_std: float = 0.09
    threshold: float = 0.0045


def laser_gains(sensor: Sensor, noise: Noise) -> Floats:
    """(H,) gain of each laser, the same for every scan of a sensor; a few lasers are weak."""
    rng = np.random.Generator(np.random.Philox(key=sensor.shape[0]))
    gains = rng.normal(1.15, noise.gain_std, sensor.shape[0])
    gains[rng.random(sensor.shape[0]) < 0.08] *= 0.6
    return np.clip(gains, 0.4, 1.4).astype(np.float32)


def patches(points: Floats, size: float) -> Floats:
    """(N,) pseudo-random values, uniform in [0, 1), one per cube of ``size`` metres in which the points (N, 3) lie.

    A hash of the cube's indices, so that all points of a window pane get the same value.
    """
    x, y, z = np.floor(points / np.float32(size)).astype(np.int64).astype(np.uint64).T
    mixed = x * np.uint64(0x9E3779B97F4A7C15) ^ y * np.uint64(0xC2B2AE3D27D4EB4F) ^ z * np.uint64(0x165667B19E3779F9)
    mixed = (mixed ^ (mixed >> np.uint64(29))) * np.uint64(0xBF58476D1CE4E5B9)
    upper = (mixed ^ (mixed >> np.uint64(32))) >> np.uint64(40)
    return np.asarray(upper.astype(np.float32) / np.float32(2**24))


def see_through(
    stage: Stage,
    hits: Hits,
    origins: Floats,
    directions: Floats,
    eye: Floats,
    surfaces: SurfaceTable,
    rng: np.random.Generator,
) -> None:
    """Continue, in place, the rays that pass through glass, wire mesh and leaves, through at most three layers."""
    on = np.flatnonzero(hits.surface != MISS)
    for _ in range(3):
        share = _THROUGH[surfaces.material[hits.surface[on]]]
        on, share = on[share > 0], share[share > 0]
        pane = _GLOSS[surfaces.material[hits.surface[on]]] > 0
        draw = rng.random(len(on), np.float32)
        glass = on[pane]
        draw[pane] = patches(origins[glass] + hits.distance[glass, None] * directions[glass], 0.4)
        on = on[draw < share]
        if not len(on):
            return
        start = hits.distance[on] + np.float32(0.004)
        again = stage.cast(origins[on] + start[:, None] * directions[on], directions[on], eye)
        hits.distance[on] = start + again.distance
        hits.surface[on] = again.surface
        hits.normal[on] = again.normal
        on = on[again.surface != MISS]


def measure(
    hits: Hits,
    directions: Floats,
    laser: NDArray[np.intp],
    surfaces: SurfaceTable,
    gains: Floats,
    noise: Noise,
    rng: np.random.Generator,
) -> tuple[NDArray[np.intp], Floats, Floats]:
    """Sample which rays return, and their range and reflectance.

    Args:
        hits: the hits of N rays.
        directions: (N, 3) unit vectors.
        laser: (N,) the laser of each ray.
        surfaces: the surfaces of the scene.
        gains: (H,) gain of each laser.
        noise: the measurement noise of the sensor.
        rng: samples noise and dropped rays.

    Returns:
        (M,) indices of the rays that return, (M,) ranges in metres and (M,) reflectances in [0, 1).
    """
    back = np.flatnonzero(hits.surface != MISS)
    surface, far = hits.surface[back], hits.distance[back]
    material = surfaces.material[surface]
    facing = np.abs(np.einsum("ij,ij->i", hits.normal[back], directions[back]))
    power = surfaces.reflectance[surface] * (1 - _GLOSS[material] * (1 - facing * facing))
    signal = power * np.minimum(1, facing * 9) * np.minimum(1, 900 / np.maximum(far * far, 1)) + np.float32(0.002)
    kept = (1 - _LOST[material]) * signal**2 / (signal**2 + np.float32(noise.threshold) ** 2)
    returned = np.flatnonzero(rng.random(len(back), np.float32) < kept)
    back, far, material, power, facing = (
        back[returned],
        far[returned],
        material[returned],
        power[returned],
        facing[returned],
    )
    draw = rng.standard_normal((2, len(back)), np.float32)
    seen = power + _SPECKLE[material] * draw[0] * np.minimum(1, 4 * power)
    step = np.minimum(far * np.float32(1 / _STEP), len(_FALL) - 1).astype(np.int32)
    value = seen * gains[laser[back]] * _FALL[step] * np.clip((facing - 0.015) / 0.075, 0, 1)
    value = np.where(value < _DARK, 3 * value - 2 * _DARK, value) * (rng.random(len(back), np.float32) > _BLANK)
    measured = far + np.maximum(np.float32(noise.range_std), _DEPTH[material]) * draw[1]
    reflectance = np.floor(np.clip(value, 0, 0.995) * LEVELS) / LEVELS
    return back, measured, reflectance.astype(np.float32)
