"""Lists of SemanticKITTI at 1, 10 and 20 % of its labels, real and mixed, for MMDetection3D's
configurations.

    python tools/research/semantic_kitti_shares.py SEMANTIC_KITTI BANK OUT [--share 10 ...] [--order uniform ...]
        [--ratio 0.5]

BANK is a bank, a folder of labelled scans or a model's name. For each share and order, OUT gets a
mixed list, and one of real scans alone in which every scan occurs often enough for as many
iterations. The commands of both trainings are printed. ``uniform`` takes evenly spread scans, as
LaserMix does; ``sequential`` the first ones of each sequence: most places are never seen. The
generator must not know more labels than the trainer: use the town, or a model that was adapted to
the same labelled scans.
"""

import argparse
import json
from pathlib import Path

from lidar_synth.integrations.mmdet3d_infos import write_infos
from lidar_synth.integrations.mmdet3d_lists import ORDERS, semantic_kitti_list
from tqdm import tqdm

from lidar_synth.errors import ConfigError

CONFIGS = ("frnet_semantickitti.py", "minkunet_semantickitti.py")
"""Of configs/mmdet3d: FRNet with FrustumMix, MinkUNet with LaserMix and PolarMix."""


def write(
    root: Path, bank: str, out: Path, share: float, order: str, ratio: float
) -> list[Path]:
    """Write the real and the mixed list; returns their paths."""
    listed = semantic_kitti_list(root, out / "labelled.json", share=share, order=order)
    mixed = write_infos(
        out / "mixed",
        listed,
        {"synthetic": bank, "ratio": ratio, "seed": 0},
        data_root=root,
    )
    values = json.loads(listed.read_text())
    values["data_list"] *= round(1 / (1 - ratio))
    repeated = out / "repeated.json"
    repeated.write_text(json.dumps(values))
    real = write_infos(
        out / "real",
        repeated,
        {"synthetic": bank, "ratio": 0.0, "seed": 0},
        data_root=root,
    )
    return [real, mixed]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("root", type=Path)
    parser.add_argument("bank")
    parser.add_argument("out", type=Path)
    parser.add_argument(
        "--share",
        type=float,
        nargs="+",
        default=[1, 10, 20],
        help="per cent of the scans",
    )
    parser.add_argument("--order", nargs="+", choices=ORDERS, default=list(ORDERS))
    parser.add_argument(
        "--ratio",
        type=float,
        default=0.5,
        help="share of synthetic scans: 1/2, 2/3 or 3/4",
    )
    given = parser.parse_args()

    if (
        not 0 < given.ratio < 1
        or abs(1 / (1 - given.ratio) - round(1 / (1 - given.ratio))) > 0.03
    ):
        raise ConfigError(
            f"ratio {given.ratio}",
            "0.5, 0.667 or 0.75, with which real scans occur a whole number of times",
        )
    tasks = [(share, order) for order in given.order for share in given.share]
    lines = []
    for share, order in tqdm(tasks, desc="lists"):
        for path in write(
            given.root,
            given.bank,
            given.out / f"{order}-{share:g}",
            share / 100,
            order,
            given.ratio,
        ):
            name = f"{order}-{share:g}-{path.parent.name}"
            lines += [
                f"python tools/train.py configs/mmdet3d/{config} --work-dir "
                f"work_dirs/{config.split('_')[0]}-{name} "
                f"--cfg-options train_dataloader.dataset.ann_file={path.resolve()}"
                for config in CONFIGS
            ]
    print("\n".join(lines))


if __name__ == "__main__":
    main()
