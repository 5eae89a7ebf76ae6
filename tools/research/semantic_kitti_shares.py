"""Lists of SemanticKITTI at 1, 10 and 20 % of its labels, real and mixed, for MMDetection3D's
configurations.

    python tools/research/semantic_kitti_shares.py SEMANTIC_KITTI BANK OUT [--share 10]
        [--order uniform] [--ratio 0.5]

BANK is a bank, a folder of labelled scans or a model's name. For each share and order, OUT gets a
mixed list, and one of real scans alone in which every scan occurs often enough for as many
iterations. The commands of both trainings are printed. ``uniform`` takes evenly spread scans, as
LaserMix does; ``sequential`` the first ones of each sequence: most places are never seen. The
generator must not know more labels than the trainer: use the town, or a model that was adapted to
the same labelled scans.
"""

import json
from itertools import product
from pathlib import Path

from lidar_synth.integrations.mmdet3d_infos import write_infos
from lidar_synth.integrations.mmdet3d_lists import ORDERS, semantic_kitti_list
from tqdm import tqdm
from typer import run

from lidar_synth.errors import ConfigError

CONFIGS = ("frnet_semantickitti.py", "minkunet_semantickitti.py")
"""Of configs/mmdet3d: FRNet with FrustumMix, MinkUNet with LaserMix and PolarMix."""


def write(
    root: Path, bank: str, out: Path, share: float, order: str, ratio: float
) -> list[Path]:
    """Write the real and the mixed list; returns their paths."""
    listed = semantic_kitti_list(root, out / "labelled.json", share=share, order=order)
    values = json.loads(listed.read_text())
    values["data_list"] *= round(1 / (1 - ratio))
    repeated = out / "repeated.json"
    repeated.write_text(json.dumps(values))
    mix = {"synthetic": bank, "ratio": ratio, "seed": 0}
    real = write_infos(out / "real", repeated, mix | {"ratio": 0.0}, data_root=root)
    return [real, write_infos(out / "mixed", listed, mix, data_root=root)]


def main(
    root: Path,
    bank: str,
    out: Path,
    share: list[float] | None = None,
    order: list[str] | None = None,
    ratio: float = 0.5,
) -> None:
    """Writes the lists for shares in per cent and orders, and prints the commands."""
    if not 0 < ratio < 1 or abs(1 / (1 - ratio) - round(1 / (1 - ratio))) > 0.03:
        raise ConfigError(
            f"ratio {ratio}",
            "0.5, 0.667 or 0.75, with which real scans occur a whole number of times",
        )
    for way, percent in tqdm(list(product(order or ORDERS, share or [1, 10, 20]))):
        folder = out / f"{way}-{percent:g}"
        for path in write(root, bank, folder, percent / 100, way, ratio):
            for config in CONFIGS:
                name = f"{config.split('_')[0]}-{folder.name}-{path.parent.name}"
                tqdm.write(
                    f"python tools/train.py configs/mmdet3d/{config} --work-dir work_dirs/{name} "
                    f"--cfg-options train_dataloader.dataset.ann_file={path.resolve()}"
                )


if __name__ == "__main__":
    run(main)
