"""Rendering of the camera image by ray casting: sun, shadows, sky, glass, textures, exposure,
noise.

The camera sees the same triangles as the LiDAR at the same time. Textures are noise in world
coordinates, so that they stay fixed to surfaces from image to image; the same noise cuts leaf
shapes out of the triangles of the foliage.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidar_synth.geometry.arrays import Float32Array
from lidar_synth.lab.town.camera import CAMERA, all_pixels, pixel_rays
from lidar_synth.lab.town.cast import MISS, SceneHits, Snapshot
from lidar_synth.lab.town.catalogue import Rng
from lidar_synth.lab.town.materials import INDEX, SurfaceTable, column
from lidar_synth.lab.town.returns import cell_noise
from lidar_synth.lab.town.scene import Pose

_GRAIN = column("grain")
_GLOSS = column("gloss")
_GLASS = [INDEX["glass"], INDEX["carglass"]]
_FOLIAGE = [INDEX["leaf"], INDEX["grass"]]
_OPEN_SHARES = np.zeros(len(INDEX))
"""Share of each material that is open to camera rays."""
_OPEN_SHARES[[INDEX["leaf"], INDEX["wire"]]] = 0.42, 0.78


@dataclass(frozen=True)
class Light:
    """The illumination of a stretch.

    Args:
        sun: (3,) unit vector towards the sun.
        direct: strength of the sunlight; 0 under full cloud cover.
        ambient: strength of the light of the sky.
        cloud: cloud cover, 0..1.
    """

    sun: Float32Array
    direct: float
    ambient: float
    cloud: float


def sample_light(rng: Rng) -> Light:
    """A random time of day and weather."""
    height = np.radians(rng.uniform(25, 62))
    azimuth = rng.uniform(0, 2 * np.pi)
    level = np.cos(height)
    sun = (np.cos(azimuth) * level, np.sin(azimuth) * level, np.sin(height))
    cloud = float(np.clip(rng.normal(0.3, 0.4), 0, 1))
    direct = 3.0 * (1 - cloud) ** 0.7
    return Light(np.array(sun, np.float32), direct, 0.55 + 0.45 * cloud, cloud)


def sky(directions: Float32Array, light: Light) -> Float32Array:
    """(N, 3) linear RGB of the sky along unit vectors; overexposed at the horizon and near the sun,
    as in photos."""
    up = np.clip(directions[:, 2:], 0, 1)
    zenith = up**0.45
    clear = np.array([0.22, 0.44, 0.86], np.float32)
    horizon = np.array([1.0, 1.02, 1.04], np.float32)
    blue = clear * (1 - light.cloud) + 0.85 * light.cloud
    colour = blue * zenith + horizon * (1 - zenith)
    white = _clouds(directions[:, :2] / (up + 0.12), light.cloud) * up**0.3
    colour = colour * (1 - white) + 1.05 * white
    near = np.clip(directions @ light.sun, 0, 1)[:, None]
    glare = 0.25 * near**8 + 2 * near**300
    return np.asarray(colour + light.direct * glare, np.float32)


def _clouds(places: Float32Array, cover: float) -> Float32Array:
    """(N, 1) how white clouds are at places (N, 2) of the sky, 0..1."""
    octaves = [_value_noise(places * k, k) / k for k in (1.5, 3.0, 6.0)]
    puffs = np.sum(octaves, axis=0)[:, None]
    return np.asarray(np.clip(2.2 * (puffs - 0.62 + 0.35 * cover), 0, 1))


def _value_noise(places: Float32Array, layer: float) -> Float32Array:
    """(N,) value noise in 0..1 at points of the plane (N, 2); each ``layer`` is an independent
    pattern."""
    base = np.floor(places)
    f = places - base
    f = f * f * (3 - 2 * f)
    value = np.zeros(len(places), np.float32)
    cell = np.insert(base, 2, layer, axis=1) + np.float32(0.5)
    for corner in ((0, 0), (0, 1), (1, 0), (1, 1)):
        shares = np.where(corner, f, 1 - f)
        noise = cell_noise(cell + np.array((*corner, 0), np.float32), 1.0)
        value += shares[:, 0] * shares[:, 1] * noise
    return value


def camera_hits(
    snapshot: Snapshot,
    eye: Float32Array,
    directions: Float32Array,
    surfaces: SurfaceTable,
) -> SceneHits:
    """The first hits of camera rays: as ``Snapshot.cast``, but rays pass through the gaps of
    foliage and wire mesh."""
    hits = snapshot.cast(np.broadcast_to(eye, directions.shape), directions, eye)
    rays = hits.found()
    for _ in range(4):
        share = _OPEN_SHARES[surfaces.material[hits.surface[rays]]]
        rays = rays[share > 0]
        rays = rays[cell_noise(hits.places(rays), 0.035) < share[share > 0]]
        if not len(rays):
            break
        rays = snapshot.cast_on(hits, rays, 0.01, eye)
    return hits


_JOINTS = (
    ("brick", 0.075, 0.25, 14),
    ("tile", 0.33, 0.26, 45),
    ("stone", 0.24, 0.45, 30),
)
"""Walls and roofs with joints: height and width of a stone, metres, and the distance up to which
they are seen."""


def _darken_joints(
    value: Float32Array,
    place: Float32Array,
    normal: Float32Array,
    far: Float32Array,
    material: NDArray[np.uint8],
) -> None:
    """Darken, in place, the joints between bricks, tiles and stones."""
    along = place[:, 0] * -normal[:, 1] + place[:, 1] * normal[:, 0]
    for name, height, width, near in _JOINTS:
        rays = np.flatnonzero((material == INDEX[name]) & (far < near))
        level = place[rays, 2] / height
        upright = (along[rays] / width + 0.5 * np.floor(level)) % 1 < 0.07
        value[rays] *= np.where((level % 1 < 0.16) | upright, 0.72, 1)


def _texture(
    place: Float32Array,
    normal: Float32Array,
    far: Float32Array,
    material: NDArray[np.uint8],
) -> Float32Array:
    """(N,) brightness factors of the texture, around 1: noise at two scales, no finer than a pixel,
    and the joints between bricks, tiles, stones and slabs."""
    size = np.float32(0.02) * 2 ** np.ceil(np.log2(np.maximum(far / 12, 1)))
    fine = cell_noise(place / size[:, None], 1.0) - 0.5
    coarse = cell_noise(place, 0.55) - 0.5
    value = 1 + _GRAIN[material] * (1.1 * fine + 0.5 * coarse)
    _darken_joints(value, place, normal, far, material)
    slabs = (material == INDEX["paving"]) & (far < 14) & (normal[:, 2] > 0.8)
    rays = np.flatnonzero(slabs)
    value[rays] *= np.where((place[rays, :2] / 0.4 % 1 < 0.05).any(1), 0.8, 1)
    return value.astype(np.float32)


def shade(
    snapshot: Snapshot,
    eye: Float32Array,
    directions: Float32Array,
    surfaces: SurfaceTable,
    light: Light,
) -> tuple[Float32Array, SceneHits]:
    """Linear RGB (N, 3) along camera rays, and their hits."""
    hits = camera_hits(snapshot, eye, directions, surfaces)
    image = np.empty_like(directions)
    missed = hits.surface == MISS
    image[missed] = sky(directions[missed], light)
    rays = hits.found()
    ray = directions[rays]
    far = hits.distance[rays]
    surface = hits.surface[rays]
    normal = hits.normal[rays]
    normal = normal * -np.sign(np.einsum("ij,ij->i", normal, ray))[:, None]
    place = hits.places(rays)
    material = surfaces.material[surface]
    texture = _texture(place, normal, far, material)
    colour = surfaces.colour[surface] ** 2.2 * texture[:, None]
    facing = _facing(normal, material, light)
    lit = _lit(snapshot, place, normal, facing, light)
    under = 0.55 + 0.45 * normal[:, 2]
    glow = light.ambient * under[:, None] * np.array([0.92, 0.98, 1.08], np.float32)
    warm = np.array([1.06, 1.0, 0.90], np.float32)
    shaded = colour * (glow + light.direct * (lit * facing)[:, None] * warm)
    _reflect(shaded, ray, normal, material, lit, light)
    haze = 1 - np.exp(-far / 700)[:, None]
    image[rays] = shaded * (1 - haze) + haze * np.array([0.85, 0.9, 0.97], np.float32)
    return image, hits


def _facing(
    normal: Float32Array, material: NDArray[np.uint8], light: Light
) -> Float32Array:
    """(N,) share of the sunlight that surfaces reflect by their direction."""
    facing = normal @ light.sun
    # Light passes through foliage: both sides of its triangles are lit.
    leaf = np.isin(material, _FOLIAGE)
    lit = np.where(leaf, 0.35 + 0.5 * np.abs(facing), np.clip(facing, 0, 1))
    return np.asarray(lit)


def _lit(
    snapshot: Snapshot,
    place: Float32Array,
    normal: Float32Array,
    facing: Float32Array,
    light: Light,
) -> Float32Array:
    """(N,) 1 where the sun is seen from a place, 0 in the shadow."""
    lit = np.zeros(len(place), np.float32)
    if light.direct > 0.1:
        test = np.flatnonzero(facing > 0)
        start = place[test] + 0.02 * normal[test]
        towards = np.ascontiguousarray(np.broadcast_to(light.sun, start.shape))
        lit[test] = snapshot.cast(start, towards).surface == MISS
    return lit


def _reflect(
    shaded: Float32Array,
    ray: Float32Array,
    normal: Float32Array,
    material: NDArray[np.uint8],
    lit: Float32Array,
    light: Light,
) -> None:
    """Add, in place, reflections of sky and sun on glass and glossy paint; near the horizon they
    show dark houses."""
    rays = np.flatnonzero(_GLOSS[material] > 0.25)
    across = np.einsum("ij,ij->i", ray[rays], normal[rays])
    mirrored = ray[rays] - 2 * across[:, None] * normal[rays]
    above = np.clip((mirrored[:, 2:] - 0.12) * 4, 0, 1)
    picture = above * sky(mirrored, light) + (1 - above) * 0.16 * light.ambient
    base = np.where(np.isin(material[rays], _GLASS), 0.18, 0.05)
    share = (base + 0.75 * (1 - np.abs(across)) ** 4)[:, None]
    glint = np.clip(mirrored @ light.sun, 0, 1) ** 90 * lit[rays] * light.direct
    shaded[rays] = shaded[rays] * (1 - share) + share * np.minimum(picture, 1.6)
    shaded[rays] += 0.8 * glint[:, None]


def render(
    snapshot: Snapshot,
    pose: Pose,
    surfaces: SurfaceTable,
    light: Light,
    rng: Rng,
) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 RGB camera image of the scene.

    Args:
        snapshot: the stretch at the time of the scan.
        pose: (4, 4) sensor to world.
        surfaces: the surfaces of the scene.
        light: sun and sky.
        rng: samples the noise of the camera.
    """
    assert CAMERA.image_size is not None
    width, height = CAMERA.image_size
    pixels = all_pixels()
    eye, rays = pixel_rays(pose, pixels)
    image, hits = shade(snapshot, eye, rays, surfaces, light)
    edge = np.flatnonzero(_edges(hits, height, width).ravel())
    for shift in ((0.33, 0.33), (-0.33, 0.33), (0.0, -0.33)):
        _, more = pixel_rays(pose, pixels[edge] + shift)
        image[edge] += np.minimum(shade(snapshot, eye, more, surfaces, light)[0], 1.3)
    image[edge] /= 4
    value = image.reshape(height, width, 3)
    value *= _exposure(value)
    grain = 0.004 + 0.012 * np.sqrt(np.clip(value, 0, 1))
    value += rng.standard_normal(value.shape, np.float32) * grain
    return tone_map(value)


def _exposure(image: Float32Array) -> float:
    """The exposure factor that maps the median of the lower half of the image to a mid grey."""
    lower = image[len(image) // 2 :] @ np.array([0.3, 0.59, 0.11], np.float32)
    return float(np.clip(0.20 / max(float(np.median(lower)), 0.02), 0.6, 3.5))


def tone_map(image: Float32Array) -> NDArray[np.uint8]:
    """Tone mapping: uint8 sRGB of exposed linear RGB, with soft clipping of highlights."""
    curve = np.clip(image, 0, None)
    soft = curve * (1 + 0.18 * curve) / (1 + 0.30 * curve)
    curve = np.clip(soft, 0, 1) ** (1 / 2.2)
    return np.asarray(curve * 255 + 0.5, np.uint8)


def _edges(hits: SceneHits, height: int, width: int) -> NDArray[np.bool_]:
    """(H, W) pixels at the edges between surfaces, which are then antialiased."""
    surface = hits.surface.reshape(height, width)
    edge = np.zeros(surface.shape, bool)
    edge[:, :-1] |= surface[:, :-1] != surface[:, 1:]
    edge[:-1] |= surface[:-1] != surface[1:]
    edge[:, 1:] |= edge[:, :-1]
    return edge
