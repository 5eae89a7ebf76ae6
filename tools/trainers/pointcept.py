"""Pointcept's own ``tools/train.py`` with its evaluation: SparseUNet on SemanticKITTI, and Sonata's pretraining."""

import re
from collections.abc import Iterator
from pathlib import Path

from trainers.trial import ROOT, Failed, Row, Trial

TITLE = "Pointcept"

SCRIPTS = Path(__file__).parent / "scripts"
PACKAGES = (
    "spconv", "torch_geometric", "timm", "peft", "transformers", "wandb", "einops", "termcolor", "addict", "yapf",
    "tensorboardX", "SharedArray", "open3d", "plyfile", "scipy", "pandas", "torchvision", "setuptools",
)  # fmt: skip
LEFT_OUT = "mixed precision; `tools/stand_ins` replaces pointops and, to save an hour, torch_scatter and torch_cluster"
COMMON = """
seed, batch_size, num_worker, mix_prob, enable_wandb, epoch, eval_epoch = 1, 2, 2, 0, False, {epochs}, {epochs}
data = dict(train=dict(data_root={root!r}, mixture=dict(synthetic={bank!r}, ratio=0.5, labels={labels!r})))
"""
SEGMENTATION = """
_base_ = [{stock!r}]
custom_imports = dict(imports=["lidar_synth.integrations.pointcept"], allow_failed_imports=False)
hooks = [dict(type=name) for name in (
    "SynthEpoch", "CheckpointLoader", "ModelHook", "IterationTimer", "InformationWriter", "SemSegEvaluator",
    "CheckpointSaver")]
hooks[-1]["save_freq"] = 1
{common}
data["train"]["type"] = "MixedSemanticKITTI"
data |= dict(val=dict(data_root={root!r}))
"""
PRETRAINING = """
_base_ = [{stock!r}]
model = dict(backbone=dict(
    enc_depths=(1,) * 5, enc_channels=(12, 12, 24, 24, 48), enc_num_head=(1,) * 5, enc_patch_size=(64,) * 5,
    enable_flash=False), head_in_channels=96, head_hidden_channels=32, head_embed_channels=16, head_num_prototypes=32)
param_dicts = [dict(keyword="enc0", lr=0.004)]
scheduler = dict(max_lr=[0.004, 0.004])
{common}
data["train"]["split"] = ["train"]
"""


def rows(trial: Trial) -> Iterator[Row]:
    """Two epochs and a resumed one of the stock SparseUNet; one of Sonata on scans without labels."""
    python = trial.environment(*PACKAGES)
    tree = trial.tree("POINTCEPT_ROOT")
    (trial.folder / "semantic_kitti").mkdir()
    (trial.folder / "semantic_kitti" / "dataset").symlink_to(trial.data.semantic_kitti)
    stock = "configs/semantic_kitti/semseg-spunet-v1m1-0-base.py"
    text = SEGMENTATION.format(
        stock=str(tree / stock), root=str(trial.folder / "semantic_kitti"), common=common(trial, 2)
    )
    whole = run(trial, python, tree, "segmentation", text, expect=[r"loss: \d", r"Val result: mIoU"])
    saved = trial.folder / "segmentation" / "model" / "epoch_1.pth"
    if not saved.is_file():
        raise Failed("no checkpoint after the first epoch")
    rest = run(trial, python, tree, "resumed", text, "resume=True", f"weight={saved}")
    if samples(rest) != {1: samples(whole)[1]}:
        raise Failed(f"the resumed run saw {samples(rest)} instead of {samples(whole)[1]}")
    yield trial.row(
        f"tools/train.py --config-file {stock}", ["training", "validation", "checkpoint", "resume"], LEFT_OUT
    )

    config = ROOT / "configs" / "pointcept" / "pretrain_sonata_semantickitti.py"
    text = PRETRAINING.format(stock=str(config), common=common(trial, 1, "none"))
    run(trial, python, tree, "pretraining", text, expect=[r"loss: \d"])
    if not (trial.folder / "pretraining" / "model" / "model_last.pth").is_file():
        raise Failed("no checkpoint")
    left_out = (
        f"{LEFT_OUT}; flash attention; the stock width: 24 GB of memory; Pointcept has no validation in pretraining"
    )
    yield trial.row(f"tools/train.py --config-file {config.name}", ["training", "checkpoint"], left_out)


def common(trial: Trial, epochs: int, labels: str = "generated") -> str:
    """Data and schedule of a short run."""
    root, bank = str(trial.folder / "semantic_kitti"), str(trial.data.bank)
    return COMMON.format(root=root, bank=bank, epochs=epochs, labels=labels)


def run(
    trial: Trial, python: Path, tree: Path, name: str, text: str, *options: str, expect: list[str] | None = None
) -> str:
    """Run ``tools/train.py`` with a configuration."""
    config = trial.folder / f"{name}.py"
    config.write_text(text)
    command = [python, SCRIPTS / "pointcept_cpu.py", "tools/train.py", "--config-file", config]
    command += ["--options", f"save_path={trial.folder / name}", *options]
    return trial.run(name, command, cwd=tree, expect=expect or [], minutes=120)


def samples(output: str) -> dict[int, list[str]]:
    """The training samples of each epoch, in the order of their names."""
    found: dict[int, list[str]] = {}
    for epoch, name in re.findall(r"epoch (\d+) sample (\S+)", output):
        found.setdefault(int(epoch), []).append(name)
    return {epoch: sorted(names) for epoch, names in found.items()}
