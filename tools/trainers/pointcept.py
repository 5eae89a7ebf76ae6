"""Pointcept's own ``tools/train.py`` with its evaluation: SparseUNet on SemanticKITTI, and Sonata's
pretraining."""

import re
from collections.abc import Iterator
from pathlib import Path

from trainers.rangenet import mixture
from trainers.trial import NOT_PIP, PIP, ROOT, Failed, Row, Trial

TITLE = "Pointcept"

PAGE = "pointcept"
SCRIPTS = Path(__file__).parent / "scripts"
LEFT_OUT = (
    "mixed precision; `tools/stand_ins` replaces pointops and, to save an hour, torch_scatter and "
    "torch_cluster"
)
SEGMENTATION = """
_base_ = [{stock!r}]
seed, batch_size, num_worker, mix_prob, enable_wandb, epoch, eval_epoch = 1, 2, 2, 0, False, 2, 2
data = dict(train=dict(data_root={root!r}), val=dict(data_root={root!r}))
"""
PRETRAINING = """
_base_ = [{stock!r}]
model = dict(backbone=dict(
    enc_depths=(1,) * 5, enc_channels=(12, 12, 24, 24, 48), enc_num_head=(1,) * 5,
    enc_patch_size=(64,) * 5, enable_flash=False),
    head_in_channels=96, head_hidden_channels=32, head_embed_channels=16, head_num_prototypes=32)
param_dicts = [dict(keyword="enc0", lr=0.004)]
scheduler = dict(max_lr=[0.004, 0.004])
seed, batch_size, num_worker, mix_prob, enable_wandb, epoch, eval_epoch = 1, 2, 2, 0, False, 1, 1
data = dict(train=dict(data_root={root!r}, mixture={mix!r}, split=["train"]))
"""


def rows(trial: Trial) -> Iterator[Row]:
    """Two epochs and a resumed one of the stock SparseUNet; one of Sonata on scans without
    labels."""
    python = trial.environment()
    trial.type_page("install", python, PAGE, {}, skip=NOT_PIP)
    tree = trial.tree("POINTCEPT_ROOT")
    root = trial.folder / "semantic_kitti"
    root.mkdir()
    (root / "dataset").symlink_to(trial.data.semantic_kitti)
    yield segmentation(trial, python, tree, root)
    yield pretraining(trial, python, tree, root)


def common(tree: Path) -> dict[str, object]:
    """What every command of the page has here: the clone, and the script for a CPU that the page
    names."""
    return {
        "Pointcept": tree,
        "python tools/train.py": f"python {SCRIPTS / 'pointcept_cpu.py'} tools/train.py",
    }


def samples(output: str) -> dict[int, list[str]]:
    """The training samples of each epoch, in the order of their names."""
    found: dict[int, list[str]] = {}
    for epoch, name in re.findall(r"epoch (\d+) sample (\S+)", output):
        found.setdefault(int(epoch), []).append(name)
    return {epoch: sorted(names) for epoch, names in found.items()}


def segmentation(trial: Trial, python: Path, tree: Path, root: Path) -> Row:
    """Two epochs, and the second one once more in a resumed run."""
    stock = "configs/semantic_kitti/semseg-spunet-v1m1-0-base.py"
    base = trial.folder / "base.py"
    base.write_text(SEGMENTATION.format(stock=str(tree / stock), root=str(root)))
    names = common(tree) | {"semseg-spunet-v1m1-0-base.py": base}
    names["/data/mix.yaml"] = mixture(trial)
    names['dict(type="CheckpointSaver")'] = 'dict(type="CheckpointSaver", save_freq=1)'
    expect = [r"loss: \d", r"Val result: mIoU"]

    def train(name: str, more: str = "") -> dict[int, list[str]]:
        own = names | {"exp/mixed": f"{trial.folder / name} {more}"}
        said = trial.type_page(
            name, python, PAGE, own, skip=PIP, expect=expect, minutes=120
        )
        return samples(said)

    whole = train("segmentation")
    saved = trial.folder / "segmentation" / "model" / "epoch_1.pth"
    if not saved.is_file():
        raise Failed("no checkpoint after the first epoch")
    rest = train("resumed", f"resume=True weight={saved}")
    if rest != {1: whole[1]}:
        raise Failed(f"the resumed run saw {rest} instead of {whole[1]}")
    ran = ["training", "validation", "checkpoint", "resume"]
    return trial.row(f"tools/train.py --config-file {stock}", ran, LEFT_OUT)


def pretraining(trial: Trial, python: Path, tree: Path, root: Path) -> Row:
    """One epoch of Sonata."""
    sonata = ROOT / "configs" / "pointcept" / "pretrain_sonata_semantickitti.py"
    config = trial.folder / "sonata.py"
    mix = {"synthetic": str(trial.data.bank), "ratio": 0.5, "labels": "none"}
    own = PRETRAINING.format(stock=str(sonata), root=str(root), mix=mix)
    config.write_text(own)
    names = common(tree) | {"exp/mixed": trial.folder / "sonata"}
    names["configs/semantic_kitti/mixed.py"] = config
    skip = f"{PIP}|^cat"
    expect = [r"loss: \d"]
    trial.type_page(
        "pretraining", python, PAGE, names, skip=skip, expect=expect, minutes=120
    )
    if not (trial.folder / "sonata" / "model" / "model_last.pth").is_file():
        raise Failed("no checkpoint")
    left_out = (
        f"{LEFT_OUT}; flash attention; the stock width: 24 GB of memory; Pointcept has no "
        "validation in pretraining"
    )
    script = f"tools/train.py --config-file {sonata.name}"
    return trial.row(script, ["training", "checkpoint"], left_out)
