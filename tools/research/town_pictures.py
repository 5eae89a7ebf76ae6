"""Make the images of docs/town.md: streets from above, camera images, one scan as a sheet.

python tools/research/town_pictures.py [OUT]            (OUT = docs/town)
"""

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from PIL import Image
from tqdm import tqdm

from lidar_synth.lab.town import STRETCH_FRAMES, Town
from lidar_synth.lab.town.shading import sample_light, shade, tone_map
from lidar_synth.lab.town.street import KINDS
from lidar_synth.lab.town.world import LIGHT, rng_for
from lidar_synth.viz import write_view

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
    back = pose[:3, 0]
    side = pose[:3, 1]
    up = np.array((0.0, 0.0, 1.0))
    eye = pose[:3, 3] - 22 * back - 11 * side + 20 * up
    ahead = pose[:3, 3] + 20 * back - eye
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, up)
    right /= np.linalg.norm(right)
    width, height = SIZE
    # Four rays per pixel against jagged edges.
    x, y = np.meshgrid(
        (np.arange(2 * width) + 0.5) / width - 1,
        (np.arange(2 * height) + 0.5) / width - height / width,
    )
    rays = ahead + 0.62 * (x[..., None] * right - y[..., None] * np.cross(right, ahead))
    rays = (
        (rays / np.linalg.norm(rays, axis=-1, keepdims=True))
        .reshape(-1, 3)
        .astype(np.float32)
    )
    light = sample_light(rng_for(LIGHT, town.seed, index // STRETCH_FRAMES))
    image, _ = shade(
        snapshot, eye.astype(np.float32), rays, town.world(index).surfaces, light
    )
    linear = np.minimum(image, 1.2).reshape(height, 2, width, 2, 3).mean((1, 3))
    return tone_map(linear * float(0.23 / np.median(linear.mean(-1))))


def save(path: Path, pixels: np.ndarray, width: int, colours: int) -> None:
    """Write a PNG with few colours and a given width, small enough for a repository."""
    image = Image.fromarray(pixels)
    image = image.resize(
        (width, round(image.height * width / image.width)), Image.Resampling.LANCZOS
    )
    image.quantize(
        colours,
        Image.Quantize.FASTOCTREE if colours > 128 else None,
        dither=Image.Dither.NONE,
    ).save(path, optimize=True)


def main() -> None:
    """Writes the three images."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", nargs="?", type=Path, default=Path("docs/town"))
    out: Path = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    town = Town(seed=0, scans=1000)
    indices = stretches(town)
    above = [from_above(town, i + 6) for i in tqdm(indices[:4], desc="streets")]
    save(
        out / "streets.png",
        np.concatenate([np.concatenate(above[:2], 1), np.concatenate(above[2:], 1)]),
        1020,
        80,
    )
    seen = [town.image(i + 8) for i in tqdm(indices[:3], desc="pictures")]
    save(out / "camera.png", np.concatenate(seen), 900, 80)
    with TemporaryDirectory() as folder:
        sheet = Path(folder) / "scan.png"
        write_view(sheet, [town[indices[0] + 8]], title="a scan of the town")
        save(out / "scan.png", np.asarray(Image.open(sheet).convert("RGB")), 1000, 255)


if __name__ == "__main__":
    main()
