"""Make the images of docs/town.md: streets from above, camera images, one scan as a sheet.

python tools/research/town_pictures.py [OUT]            (OUT = docs/town)
"""

from pathlib import Path
from typing import Annotated

import numpy as np
from gallery import save, sheet
from tqdm import tqdm
from typer import Argument, run

from lidar_synth.lab.town import STRETCH_FRAMES, Town
from lidar_synth.lab.town.shading import sample_light, shade, tone_map
from lidar_synth.lab.town.street import KINDS
from lidar_synth.lab.town.world import LIGHT, rng_for

SIZE = (510, 330)
"""Width and height of one street from above."""


def stretches(town: Town) -> list[int]:
    """The number of the first scan of a stretch of each kind of street, and of one more stretch."""
    first: dict[str, int] = {}
    for k in range(40):
        first.setdefault(town.world(k * STRETCH_FRAMES).street.kind, k * STRETCH_FRAMES)
        if len(first) == len(KINDS):
            break
    return [first[kind] for kind in KINDS if kind in first]


def from_above(town: Town, index: int) -> np.ndarray:
    """(H, W, 3) uint8: a stretch seen from behind the ego vehicle, 22 m up."""
    snapshot, pose, _ = town.moment(index)
    eye, rays = camera(pose)
    light = sample_light(rng_for(LIGHT, town.seed, index // STRETCH_FRAMES))
    image, _ = shade(snapshot, eye, rays, town.world(index).surfaces, light)
    width, height = SIZE
    linear = np.minimum(image, 1.2).reshape(height, 2, width, 2, 3).mean((1, 3))
    return tone_map(linear * float(0.23 / np.median(linear.mean(-1))))


def camera(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The eye (3,) above a vehicle and its rays (N, 3), four per pixel against jagged edges."""
    back, side, _, place = pose[:3].T
    up = np.array((0.0, 0.0, 1.0))
    eye = place - 22 * back - 11 * side + 20 * up
    ahead = unit(place + 20 * back - eye)
    right = unit(np.cross(ahead, up))
    width, height = SIZE
    x, y = np.meshgrid(
        (np.arange(2 * width) + 0.5) / width - 1,
        (np.arange(2 * height) + 0.5) / width - height / width,
    )
    rays = ahead + 0.62 * (x[..., None] * right - y[..., None] * np.cross(right, ahead))
    return eye.astype(np.float32), unit(rays).reshape(-1, 3).astype(np.float32)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors of length 1."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def main(out: Annotated[Path, Argument()] = Path("docs/town")) -> None:
    """Writes the three images."""
    town = Town(seed=0, scans=1000)
    indices = stretches(town)
    above = [from_above(town, i + 6) for i in tqdm(indices[:4], desc="streets")]
    rows = [np.concatenate(above[i : i + 2], 1) for i in (0, 2)]
    save(out / "streets.png", np.concatenate(rows), 1020, 80)
    seen = [town.image(i + 8) for i in tqdm(indices[:3], desc="pictures")]
    save(out / "camera.png", np.concatenate(seen), 900, 80)
    scan = sheet([town[indices[0] + 8]], title="a scan of the town")
    save(out / "scan.png", scan, 1000, 255)


if __name__ == "__main__":
    run(main)
