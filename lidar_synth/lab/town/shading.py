"""Rendering of the camera image by ray casting: sun, shadows, sky, glass, textures, exposure,
noise.

The camera sees the same triangles as the LiDAR at the same time. Textures are noise in world
coordinates, so that they stay fixed to surfaces from image to image; the same noise cuts leaf
shapes out of the triangles of the foliage.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidar_synth.lab.town.camera import CAMERA, all_pixels, pixel_rays
from lidar_synth.lab.town.cast import MISS, SceneHits, Snapshot
from lidar_synth.lab.town.materials import INDEX, SurfaceTable, column
from lidar_synth.lab.town.returns import cell_noise
from lidar_synth.lab.town.scene import Pose

Floats = NDArray[np.float32]
_GRAIN = column("grain")
_GLOSS = column("gloss")
_GLASS = np.array([INDEX["glass"], INDEX["carglass"]])
_OPEN_SHARE = {INDEX["leaf"]: 0.42, INDEX["wire"]: 0.78}
"""Share of each of these materials that is open to camera rays."""


@dataclass(frozen=True)
class Light:
    """The illumination of a stretch.

    Args:
        sun: (3,) unit vector towards the sun.
        direct: strength of the sunlight; 0 under full cloud cover.
        ambient: strength of the light of the sky.
        cloud: cloud cover, 0..1.
    """

    sun: Floats
    direct: float
    ambient: float
    cloud: float


def sample_light(rng: np.random.Generator) -> Light:
    """A random time of day and weather."""
    height = np.radians(rng.uniform(25, 62))
    azimuth = rng.uniform(0, 2 * np.pi)
    sun = np.array(
        [
            np.cos(azimuth) * np.cos(height),
            np.sin(azimuth) * np.cos(height),
            np.sin(height),
        ],
        np.float32,
    )
    cloud = float(np.clip(rng.normal(0.3, 0.4), 0, 1))
    return Light(sun, 3.0 * (1 - cloud) ** 0.7, 0.55 + 0.45 * cloud, cloud)


def sky(directions: Floats, light: Light) -> Floats:
    """(N, 3) linear RGB of the sky along unit vectors; overexposed at the horizon and near the sun,
    as in photos."""
    up = np.clip(directions[:, 2:], 0, 1)
    blue = (
        np.array([0.22, 0.44, 0.86], np.float32) * (1 - light.cloud)
        + 0.85 * light.cloud
    )
    colour = blue * up**0.45 + np.array([1.0, 1.02, 1.04], np.float32) * (1 - up**0.45)
    flat: Floats = (directions[:, :2] / (up + 0.12)).astype(np.float32)
    puffs = np.sum([_value_noise(flat * k, k) / k for k in (1.5, 3.0, 6.0)], axis=0)[
        :, None
    ]
    white = np.clip(2.2 * (puffs - 0.62 + 0.35 * light.cloud), 0, 1) * up**0.3
    colour = colour * (1 - white) + 1.05 * white
    near = np.clip(directions @ light.sun, 0, 1)[:, None]
    return np.asarray(
        colour + light.direct * (0.25 * near**8 + 2 * near**300), np.float32
    )


def _value_noise(places: Floats, layer: float) -> Floats:
    """(N,) value noise in 0..1 at points of the plane (N, 2); each ``layer`` is an independent
    pattern."""
    base = np.floor(places)
    f = places - base
    f = f * f * (3 - 2 * f)
    value = np.zeros(len(places), np.float32)
    for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
        weight = (f[:, 0] if i else 1 - f[:, 0]) * (f[:, 1] if j else 1 - f[:, 1])
        corner = np.column_stack(
            [base[:, 0] + i, base[:, 1] + j, np.full(len(base), layer)]
        )
        value += weight * cell_noise(corner.astype(np.float32) + np.float32(0.5), 1.0)
    return value


def camera_hits(
    snapshot: Snapshot,
    eye: Floats,
    directions: Floats,
    surfaces: SurfaceTable,
) -> SceneHits:
    """The first hits of camera rays: as ``Snapshot.cast``, but rays pass through the gaps of
    foliage and wire mesh."""
    origins = np.broadcast_to(eye, directions.shape)
    hits = snapshot.cast(origins, directions, eye)
    rays = np.flatnonzero(hits.surface != MISS)
    for _ in range(4):
        material = surfaces.material[hits.surface[rays]]
        share = np.select(
            [material == m for m in _OPEN_SHARE], list(_OPEN_SHARE.values()), 0.0
        )
        rays = rays[share > 0]
        share = share[share > 0]
        place = eye + hits.distance[rays, None] * directions[rays]
        rays = rays[cell_noise(place, 0.035) < share]
        if not len(rays):
            break
        start = hits.distance[rays] + np.float32(0.01)
        beyond = snapshot.cast(
            origins[rays] + start[:, None] * directions[rays], directions[rays], eye
        )
        hits.distance[rays], hits.surface[rays], hits.normal[rays] = (
            start + beyond.distance,
            beyond.surface,
            beyond.normal,
        )
        rays = rays[beyond.surface != MISS]
    return hits


def _texture(
    place: Floats,
    normal: Floats,
    far: Floats,
    material: NDArray[np.uint8],
) -> Floats:
    """(N,) brightness factors of the texture, around 1: noise at two scales, no finer than a pixel,
    and the joints between bricks, tiles, stones and slabs."""
    size = np.float32(0.02) * 2 ** np.ceil(np.log2(np.maximum(far / 12, 1)))
    fine = cell_noise(place / size[:, None], 1.0) - 0.5
    coarse = cell_noise(place, 0.55) - 0.5
    value = 1 + _GRAIN[material] * (1.1 * fine + 0.5 * coarse)
    along = place[:, 0] * -normal[:, 1] + place[:, 1] * normal[:, 0]
    for name, height, width, near in (
        ("brick", 0.075, 0.25, 14),
        ("tile", 0.33, 0.26, 45),
        ("stone", 0.24, 0.45, 30),
    ):
        rays = np.flatnonzero((material == INDEX[name]) & (far < near))
        row = np.floor(place[rays, 2] / height)
        edge = (place[rays, 2] / height % 1 < 0.16) | (
            (along[rays] / width + 0.5 * row) % 1 < 0.07
        )
        value[rays] *= np.where(edge, 0.72, 1)
    rays = np.flatnonzero(
        (material == INDEX["paving"]) & (far < 14) & (normal[:, 2] > 0.8)
    )
    value[rays] *= np.where((place[rays, :2] / 0.4 % 1 < 0.05).any(1), 0.8, 1)
    return value.astype(np.float32)


def shade(
    snapshot: Snapshot,
    eye: Floats,
    directions: Floats,
    surfaces: SurfaceTable,
    light: Light,
) -> tuple[Floats, SceneHits]:
    """Linear RGB (N, 3) along camera rays, and their hits."""
    hits = camera_hits(snapshot, eye, directions, surfaces)
    missed = hits.surface == MISS
    image = np.empty_like(directions)
    image[missed] = sky(directions[missed], light)
    rays = np.flatnonzero(~missed)
    ray = directions[rays]
    far = hits.distance[rays]
    surface = hits.surface[rays]
    normal = (
        hits.normal[rays]
        * -np.sign(np.einsum("ij,ij->i", hits.normal[rays], ray))[:, None]
    )
    place = eye + far[:, None] * ray
    material = surfaces.material[surface]
    colour = (
        surfaces.colour[surface] ** 2.2
        * _texture(place, normal, far, material)[:, None]
    )
    # Light passes through foliage: both sides of its triangles are lit.
    leaf = (material == INDEX["leaf"]) | (material == INDEX["grass"])
    facing = normal @ light.sun
    facing = np.where(leaf, 0.35 + 0.5 * np.abs(facing), np.clip(facing, 0, 1))
    lit = np.zeros(len(rays), np.float32)
    if light.direct > 0.1:
        test = np.flatnonzero(facing > 0)
        start = place[test] + 0.02 * normal[test]
        lit[test] = (
            snapshot.cast(
                start, np.ascontiguousarray(np.broadcast_to(light.sun, start.shape))
            ).surface
            == MISS
        )
    under = 0.55 + 0.45 * normal[:, 2]
    glow = light.ambient * under[:, None] * np.array([0.92, 0.98, 1.08], np.float32)
    shaded = colour * (
        glow
        + light.direct
        * (lit * facing)[:, None]
        * np.array([1.06, 1.0, 0.90], np.float32)
    )
    _reflect(
        shaded,
        ray,
        normal,
        material,
        lit,
        light,
    )
    haze = 1 - np.exp(-far / 700)[:, None]
    image[rays] = shaded * (1 - haze) + haze * np.array([0.85, 0.9, 0.97], np.float32)
    return image, hits


def _reflect(
    shaded: Floats,
    ray: Floats,
    normal: Floats,
    material: NDArray[np.uint8],
    lit: Floats,
    light: Light,
) -> None:
    """Add, in place, reflections of sky and sun on glass and glossy paint; near the horizon they
    show dark houses."""
    rays = np.flatnonzero(_GLOSS[material] > 0.25)
    across = np.einsum("ij,ij->i", ray[rays], normal[rays])
    mirrored = ray[rays] - 2 * across[:, None] * normal[rays]
    above = np.clip((mirrored[:, 2:] - 0.12) * 4, 0, 1)
    picture = above * sky(mirrored, light) + (1 - above) * 0.16 * light.ambient
    glass = np.isin(material[rays], _GLASS)
    share = np.where(glass, 0.18, 0.05) + 0.75 * (1 - np.abs(across)) ** 4
    shaded[rays] = shaded[rays] * (1 - share[:, None]) + share[:, None] * np.minimum(
        picture, 1.6
    )
    glint = np.clip(mirrored @ light.sun, 0, 1) ** 90 * lit[rays] * light.direct
    shaded[rays] += 0.8 * glint[:, None]


def render(
    snapshot: Snapshot,
    pose: Pose,
    surfaces: SurfaceTable,
    light: Light,
    rng: np.random.Generator,
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
    for du, dv in ((0.33, 0.33), (-0.33, 0.33), (0.0, -0.33)):
        _, more = pixel_rays(pose, pixels[edge] + (du, dv))
        image[edge] += np.minimum(shade(snapshot, eye, more, surfaces, light)[0], 1.3)
    image[edge] /= 4
    value = image.reshape(height, width, 3)
    value *= _exposure(value)
    value += rng.standard_normal(value.shape, np.float32) * (
        0.004 + 0.012 * np.sqrt(np.clip(value, 0, 1))
    )
    return tone_map(value)


def _exposure(image: Floats) -> float:
    """The exposure factor that maps the median of the lower half of the image to a mid grey."""
    lower = image[len(image) // 2 :] @ np.array([0.3, 0.59, 0.11], np.float32)
    return float(np.clip(0.20 / max(float(np.median(lower)), 0.02), 0.6, 3.5))


def tone_map(image: Floats) -> NDArray[np.uint8]:
    """Tone mapping: uint8 sRGB of exposed linear RGB, with soft clipping of highlights."""
    curve = np.clip(image, 0, None)
    curve = np.clip(curve * (1 + 0.18 * curve) / (1 + 0.30 * curve), 0, 1) ** (1 / 2.2)
    return np.asarray(curve * 255 + 0.5, np.uint8)


def _edges(hits: SceneHits, height: int, width: int) -> NDArray[np.bool_]:
    """(H, W) pixels at the edges between surfaces, which are then antialiased."""
    surface = hits.surface.reshape(height, width)
    edge = np.zeros(surface.shape, bool)
    edge[:, :-1] |= surface[:, :-1] != surface[:, 1:]
    edge[:-1] |= surface[:-1] != surface[1:]
    edge[:, 1:] |= edge[:, :-1]
    return edge
