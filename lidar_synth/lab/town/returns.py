"""The sensor model: from ray hits to returns with range and reflectance, or to no return.

The model is fitted to 28 labelled street scans of an HDL-64E (SemanticKITTI;
docs/research/judge.md). Reflectance is corrected for distance up to about 20 m and then decreases;
below a knee it falls to 0 faster than the signal, so that dark paint and distant asphalt give 0,
and above a shoulder it rises faster; it hardly depends on the angle of incidence except near
grazing incidence; glossy paint and glass return light only at normal incidence; number plates and
signs are retroreflectors; each laser has its own gain. Rays are dropped at random, with a
probability that grows as the returned signal falls. Soft surfaces (leaves, grass) have relief:
their returns lie before or behind the triangle, along the ray.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidar_synth.geometry import Sensor
from lidar_synth.geometry.arrays import Float32Array
from lidar_synth.lab.town.cast import SceneHits, Snapshot
from lidar_synth.lab.town.catalogue import TABLES, Rng
from lidar_synth.lab.town.materials import SurfaceTable, column
from lidar_synth.lab.town.relief import sample_relief

CALIBRATED_ON = (
    "its constants were set by statistics of 28 labelled SemanticKITTI frames, the shapes of "
    "persons by pedestrians of KITTI (2) and PandaSet (26 views) and by a network that learnt "
    "SemanticKITTI's labels"
)
"""Labels of real scans that the town owes something to, for label budgets."""
LEVELS = 256
"""Reflectance is stored as k / 256, as KITTI-360 does."""

_TRANSMISSION = column("transmission")
_DROPOUT = column("dropout")
_SPECKLE = column("speckle")
_GLOSS = column("gloss")
_ROUGHNESS = column("roughness")
_GRAZING = column("grazing")
_RELIEF = column("relief")
_STEP = 0.25
_KNOTS, _FACTORS = np.array(TABLES["reflectance by distance"]).T
_DISTANCE_FACTOR = np.interp(np.arange(0, 130, _STEP), _KNOTS, _FACTORS).astype(
    np.float32
)
"""Factor of reflectance by distance, in steps of ``_STEP`` metres."""
_KNEE = 0.30
_SLOPE = 3.0
"""Below this value the measured reflectance falls ``_SLOPE`` times as fast, to 0: dark and distant
surfaces give 0."""
_SHOULDER = 0.42
_RISE = 1.6
"""Above this value it rises ``_RISE`` times as fast: white paint and bright leaves give more than
0.5."""
_TAIL = 0.8
"""Logarithmic standard deviation of the roughness from return to return: most are small, a few are
large."""
_FLATTEST = 0.06
_DEEPEST = 0.1
"""Least cosine by which relief is divided to give a shift along the ray; largest shift as a share
of the range."""
_ZERO_SHARE = 0.02
"""Share of returns whose reflectance is 0 at random."""


@dataclass(frozen=True)
class ReturnNoise:
    """The measurement noise of the sensor.

    Args:
        range_std: metres, standard deviation of the range.
        gain_std: standard deviation of the lasers' gains; 0 for lasers of equal gain.
        threshold: signal strength at which half of the rays are dropped.
    """

    range_std: float = 0.008
    gain_std: float = 0.045
    threshold: float = 0.0045


def laser_gains(sensor: Sensor, noise: ReturnNoise) -> Float32Array:
    """(H,) gain of each laser, the same for every scan of a sensor; a few lasers are weak."""
    if not noise.gain_std:
        return np.ones(sensor.shape[0], np.float32)
    rng = np.random.Generator(np.random.Philox(key=sensor.shape[0]))
    gains = rng.normal(1.0, noise.gain_std, sensor.shape[0])
    gains[rng.random(sensor.shape[0]) < 0.1] *= 0.84
    return np.clip(gains, 0.4, 1.4).astype(np.float32)


def cell_noise(points: Float32Array, size: float) -> Float32Array:
    """(N,) pseudo-random values, uniform in [0, 1), one per cube of ``size`` metres in which the
    points (N, 3) lie.

    A hash of the cube's indices, so that all points of a window pane get the same value.
    """
    cubes = np.floor(points / np.float32(size)).astype(np.int64)
    x, y, z = cubes.astype(np.uint64).T
    mixed = (
        x * np.uint64(0x9E3779B97F4A7C15)
        ^ y * np.uint64(0xC2B2AE3D27D4EB4F)
        ^ z * np.uint64(0x165667B19E3779F9)
    )
    mixed = (mixed ^ (mixed >> np.uint64(29))) * np.uint64(0xBF58476D1CE4E5B9)
    upper = (mixed ^ (mixed >> np.uint64(32))) >> np.uint64(40)
    return np.asarray(upper.astype(np.float32) / np.float32(2**24))


def see_through(
    snapshot: Snapshot,
    hits: SceneHits,
    eye: Float32Array,
    surfaces: SurfaceTable,
    rng: Rng,
) -> None:
    """Continue, in place, the rays that pass through glass, wire mesh and leaves, through at most
    three layers."""
    rays = hits.found()
    for _ in range(3):
        material = surfaces.material[hits.surface[rays]]
        open_ = _TRANSMISSION[material] > 0
        rays = rays[open_]
        material = material[open_]
        sample = rng.random(len(rays), np.float32)
        pane = _GLOSS[material] > 0
        sample[pane] = cell_noise(hits.places(rays[pane]), 0.4)
        rays = rays[sample < _TRANSMISSION[material]]
        if not len(rays):
            return
        rays = snapshot.cast_on(hits, rays, 0.004, eye)


def measure(
    hits: SceneHits,
    laser: NDArray[np.intp],
    surfaces: SurfaceTable,
    gains: Float32Array,
    noise: ReturnNoise,
    rng: Rng,
) -> tuple[NDArray[np.intp], Float32Array, Float32Array]:
    """Sample which rays return, and their range and reflectance.

    Args:
        hits: the hits of N rays.
        laser: (N,) the laser of each ray.
        surfaces: the surfaces of the scene.
        gains: (H,) gain of each laser.
        noise: the measurement noise of the sensor.
        rng: samples noise and dropped rays.

    Returns:
        (M,) indices of the rays that return, (M,) ranges in metres and (M,) reflectances in [0, 1).
    """
    rays = hits.found()
    surface = hits.surface[rays]
    material = surfaces.material[surface]
    normal = hits.normal[rays]
    facing = np.abs(np.einsum("ij,ij->i", normal, hits.directions[rays]))
    sheen = _GLOSS[material] * (1 - facing * facing)
    power = surfaces.reflectance[surface] * (1 - sheen)
    returned = _return_probability(power, facing, hits.distance[rays], noise)
    probability = (1 - _DROPOUT[material]) * returned
    kept = np.flatnonzero(rng.random(len(rays), np.float32) < probability)
    rays = rays[kept]
    material = material[kept]
    gaussian = rng.standard_normal((3, len(rays)), np.float32)
    slope = facing[kept] + _GRAZING[material]
    far = _measure_range(hits, rays, material, slope, gaussian[1:])
    far += np.float32(noise.range_std) * gaussian[1]
    value = _response(power[kept] * gains[laser[rays]], slope, hits.distance[rays])
    value += _SPECKLE[material] * gaussian[0] * np.minimum(1, 4 * value)
    value = value * (rng.random(len(rays), np.float32) > _ZERO_SHARE)
    reflectance = np.floor(np.clip(value, 0, 0.995) * LEVELS) / LEVELS
    return rays, far, reflectance.astype(np.float32)


def _measure_range(
    hits: SceneHits,
    rays: NDArray[np.intp],
    material: NDArray[np.uint8],
    slope: Float32Array,
    gaussian: Float32Array,
) -> Float32Array:
    """(K,) metres to soft and rough surfaces, which lie before or behind their triangle."""
    behind = _ROUGHNESS[material] * gaussian[0] * np.exp(_TAIL * gaussian[1])
    soft = np.flatnonzero(_RELIEF[material])
    behind[soft] += _RELIEF[material[soft]] * sample_relief(hits.places(rays[soft]))
    distance = hits.distance[rays]
    limit = _DEEPEST * distance
    shift = np.clip(behind / np.clip(slope, _FLATTEST, 1), -limit, limit)
    return np.asarray(distance + shift)


def _return_probability(
    power: Float32Array,
    facing: Float32Array,
    distance: Float32Array,
    noise: ReturnNoise,
) -> Float32Array:
    """(N,) probability that the signal of a hit exceeds the sensor's threshold."""
    spreading = np.minimum(1, 900 / np.maximum(distance * distance, 1))
    signal = power * np.minimum(1, facing * 9) * spreading + np.float32(0.002)
    return np.asarray(signal**2 / (signal**2 + np.float32(noise.threshold) ** 2))


def _response(
    power: Float32Array, slope: Float32Array, distance: Float32Array
) -> Float32Array:
    """(N,) the reflectance that the sensor gives for a reflected power, 0 and more, without
    noise."""
    place = np.minimum(distance * np.float32(1 / _STEP), len(_DISTANCE_FACTOR) - 1)
    factor = _DISTANCE_FACTOR[place.astype(np.int32)]
    value = power * factor * np.clip((slope - 0.015) / 0.06, 0, 1)
    bright = np.maximum(value - np.float32(_SHOULDER), 0)
    value = value + np.float32(_RISE - 1) * bright
    dark = _SLOPE * value - (_SLOPE - 1) * _KNEE
    return np.asarray(np.maximum(np.where(value < _KNEE, dark, value), 0))
