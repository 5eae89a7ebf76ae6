"""Configurations of trainers for a mixture: the files that a user of each would write.

``ROOT`` stands for the folder of the real scans, of SemanticKITTI's the one that holds
``sequences``; ``REAL`` for the Python that opens them, ``MIX`` for the settings of the mixture, and
``HERE`` for the folder of these files. Paths after no quotation mark are for a shell; ``"SED``
is the root within a replacement of sed, in a string of YAML. To add a trainer, enter its files in
``TRAINERS``; every one begins with a comment that says where it belongs and what to type.
"""

import json
import re
import shlex
from pathlib import Path
from typing import Any

import yaml

from lidar_synth.errors import ConfigError, LidarSynthError, choose
from lidar_synth.files.disk import write_file
from lidar_synth.formats import open_scans

_MMDET3D_SEGMENTATION = {
    "lists.py": """# once: python HERE/lists.py
from lidar_synth.integrations.mixture import read_settings
from lidar_synth.integrations.mmdet3d_infos import write_infos
from lidar_synth.integrations.mmdet3d_lists import semantic_kitti_list

root = "ROOT"
train = semantic_kitti_list(root, "HERE/train.json")
write_infos("HERE/mixed", train, read_settings("MIX"), data_root=root)
# Without sequence 08: val_cfg = val_dataloader = val_evaluator = None in mixed.py.
semantic_kitti_list(root, "HERE/val.pkl", "val")
""",
    "mixed.py": """# python HERE/lists.py, and then tools/train.py HERE/mixed.py of MMDetection3D
_base_ = ["mmdet3d::minkunet/minkunet34_w32_spconv_8xb2-laser-polar-mix-3x_semantickitti.py"]

custom_imports = dict(imports=["lidar_synth.integrations.mmdet3d"], allow_failed_imports=False)
custom_hooks = [dict(type="SynthEpochHook")]

train_dataloader = dict(
    sampler=dict(type="SynthSampler"),
    dataset=dict(data_root="", ann_file="HERE/mixed/infos.json"),
)
val_dataloader = dict(dataset=dict(data_root="ROOT", ann_file="HERE/val.pkl"))
test_dataloader = val_dataloader

# The stock schedule, of 36 epochs, drawn out to 40.
train_cfg = dict(max_epochs=40)
param_scheduler = [
    dict(type="MultiStepLR", begin=0, end=40, by_epoch=True, milestones=[27, 36], gamma=0.1)
]
""",
}

_MMDET3D_DETECTION = {
    "lists.py": """# once: python HERE/lists.py
from lidar_synth import ObjectBank, open_scans
from lidar_synth.integrations.detection import write_gt_database
from lidar_synth.integrations.mixture import read_settings
from lidar_synth.integrations.mmdet3d_infos import write_infos
from lidar_synth.integrations.mmdet3d_lists import kitti_list

root = "ROOT"
train = kitti_list(root, "HERE/train.json")
mix = read_settings("MIX")
write_infos("HERE/mixed", train, mix, data_root=root, points="training/velodyne_reduced")
objects = ObjectBank.from_scans(open_scans(root, split="train"))
write_gt_database(objects, "HERE", origin="bottom", infos="dbinfos.pkl")
# Without ImageSets/val.txt: val_cfg = val_dataloader = val_evaluator = None in mixed.py.
kitti_list(root, "HERE/val.pkl", "val")
""",
    "mixed.py": """# python HERE/lists.py, and then tools/train.py HERE/mixed.py of MMDetection3D
_base_ = ["mmdet3d::pointpillars/pointpillars_hv_secfpn_8xb6-160e_kitti-3d-3class.py"]

custom_imports = dict(imports=["lidar_synth.integrations.mmdet3d"], allow_failed_imports=False)
custom_hooks = [dict(type="SynthEpochHook")]

train_pipeline = _base_.train_pipeline
train_pipeline[2]["db_sampler"].update(data_root="HERE", info_path="HERE/dbinfos.pkl")
train_dataloader = dict(
    sampler=dict(type="SynthSampler"),
    dataset=dict(times=1, dataset=dict(type="SynthKittiDataset", data_root="",
        ann_file="HERE/mixed/infos.json", data_prefix=dict(pts=""),
        filter_empty_gt=False, pipeline=train_pipeline)),
)
val_dataloader = dict(dataset=dict(data_root="ROOT", ann_file="HERE/val.pkl"))
test_dataloader = val_dataloader
val_evaluator = dict(ann_file="HERE/val.pkl")
test_evaluator = val_evaluator

# The stock schedule, of 80 epochs, in 40.
train_cfg = dict(max_epochs=40)
param_scheduler = [
    {key: value / 2 if key in ("T_max", "begin", "end") else value for key, value in part.items()}
    for part in _base_.param_scheduler
]
""",
}

_OPENPCDET = """# in OpenPCDet/tools: bash HERE/train.sh
export LIDAR_SYNTH_MIX=MIX
python -m lidar_synth.integrations.openpcdet train.py \\
    --cfg_file cfgs/kitti_models/pointpillar.yaml --epochs 40 \\
    --set DATA_CONFIG.DATASET MixedKitti DATA_CONFIG.DATA_PATH ROOT
"""

_POINTCEPT = """# PYTHONPATH=. python tools/train.py --config-file configs/semantic_kitti/mixed.py
# Save this as configs/semantic_kitti/mixed.py of Pointcept, which reads FOLDER/dataset/sequences:
# mkdir -p HERE/kitti && ln -sfn ROOT HERE/kitti/dataset
_base_ = ["semseg-spunet-v1m1-0-base.py"]
custom_imports = dict(imports=["lidar_synth.integrations.pointcept"], allow_failed_imports=False)
hooks = [dict(type="SynthEpoch"), dict(type="CheckpointLoader"), dict(type="ModelHook"),
         dict(type="IterationTimer"), dict(type="InformationWriter"), dict(type="SemSegEvaluator"),
         dict(type="CheckpointSaver"), dict(type="PreciseEvaluator", test_last=False)]
epoch = eval_epoch = 40
data = dict(
    train=dict(type="MixedSemanticKITTI", data_root="HERE/kitti", mixture="MIX"),
    val=dict(data_root="HERE/kitti"),
    test=dict(data_root="HERE/kitti"),
)
"""

_RANGENET = """# in train/tasks/semantic of lidar-bonnetal or SalsaNext, or in CENet:
# bash HERE/train.sh
export LIDAR_SYNTH_MIX=MIX
sed 's/max_epochs: .*/max_epochs: 40/' ARCH.yaml > HERE/arch.yaml
python -m lidar_synth.integrations.rangenet train.py -d ROOT -ac HERE/arch.yaml \\
    -dc config/labels/semantic-kitti.yaml -l HERE/log -n mixed    # of SalsaNext also: -p ""
"""

_CYLINDER3D = """# in Cylinder3D: bash HERE/train.sh
export LIDAR_SYNTH_MIX=MIX
sed 's/SemKITTI_sk/SemKITTI_mixed/; s|data_path: .*|data_path: "SED/sequences/"|' \\
    config/semantickitti.yaml > HERE/cylinder3d.yaml
python -m lidar_synth.integrations.cylinder3d train_cylinder_asym.py \\
    --config_path HERE/cylinder3d.yaml
"""

_OPEN3D_ML = """# python HERE/train.py, with randlanet_semantickitti.yml of open3d/_ml3d/configs
from pathlib import Path

import open3d.ml.torch as ml3d
from lidar_synth.integrations.open3d_ml import dataset_class
from open3d.ml.utils import Config

link = Path("HERE/kitti/dataset")  # it reads FOLDER/dataset/sequences
link.parent.mkdir(exist_ok=True)
link.unlink(missing_ok=True)
link.symlink_to("ROOT")
config = Config.load_from_file("randlanet_semantickitti.yml")
dataset = dataset_class()(dataset_path="HERE/kitti", mixture="MIX")
model = ml3d.models.RandLANet(**config.model | {"in_channels": 4})
settings = config.pipeline | {"max_epoch": 40}
ml3d.pipelines.SemanticSegmentation(model, dataset=dataset, **settings).run_train()
"""

_WAFFLEIRON = """# in WaffleIron: bash HERE/train.sh
export LIDAR_SYNTH_MIX=MIX
mkdir -p HERE/kitti && ln -sfn ROOT HERE/kitti/dataset    # it reads FOLDER/dataset/sequences
sed 's/max_epoch: .*/max_epoch: 40/' configs/WaffleIron-48-256__kitti.yaml > HERE/waffleiron.yaml
python -m lidar_synth.integrations.waffleiron launch_train.py \\
    --dataset semantic_kitti_mixed --path_dataset HERE/kitti \\
    --config HERE/waffleiron.yaml --log_path HERE/log --gpu 0
"""

_LIGHTNING = """# your own script; MODEL is your LightningModule
import lightning
import yaml
from lidar_synth import mix, open_scans
from lidar_synth.integrations.lightning import MixedData

with open("MIX") as file:
    settings = yaml.safe_load(file)
train = mix(REAL, settings.pop("synthetic"), **settings)
data = MixedData(train, batch_size=4)
trainer = lightning.Trainer(use_distributed_sampler=False, max_epochs=40)
trainer.fit(MODEL, data)
"""

TRAINERS: dict[str, dict[str, dict[str, str]]] = {
    "mmdet3d": {"segmentation": _MMDET3D_SEGMENTATION, "detection": _MMDET3D_DETECTION},
    "openpcdet": {"detection": {"train.sh": _OPENPCDET}},
    "pointcept": {"segmentation": {"mixed.py": _POINTCEPT}},
    "rangenet": {"segmentation": {"train.sh": _RANGENET}},
    "cylinder3d": {"segmentation": {"train.sh": _CYLINDER3D}},
    "open3d_ml": {"segmentation": {"train.py": _OPEN3D_ML}},
    "waffleiron": {"segmentation": {"train.sh": _WAFFLEIRON}},
    "lightning": {
        "segmentation": {"train.py": _LIGHTNING},
        "detection": {
            "train.py": _LIGHTNING.replace(
                "**settings", '**settings, epochs=40, task="detection"'
            )
        },
    },
}
"""{trainer: {task: {name of a file: its text}}}."""

MIX = "mix.yaml"
_WORDS = re.compile(r'"?\b(?:ROOT|REAL|MIX|HERE|SED)\b')

DEFAULTS: dict[str, dict[str, Any]] = {
    "segmentation": {"epochs": 40},
    "detection": {
        "ratio": {"synthetic_first": 40},
        "labels": "boxes",
        "epoch_size": "replace",
    },
}
"""Settings of the recipes that gained, for 40 epochs of the trainer: that of ``mix``, by the number
of its scans (docs/research/proof.md); for a detector, synthetic scans alone in three quarters of
them, then half and half, real ones at the end (docs/research/detectors.md)."""


def write_mixture(settings: dict[str, Any]) -> str:
    """The settings of a mixture as YAML, with the number of epochs of the recipes."""
    text = yaml.safe_dump(settings, sort_keys=False)
    return f"# For a training of 40 epochs: set the trainer to as many.\n{text}"


def tasks_of(trainer: str) -> list[str]:
    """The tasks that a trainer is connected for; raises a ConfigError on an unknown trainer."""
    return list(choose("--trainer", trainer, TRAINERS))


def configure(
    trainer: str,
    task: str,
    settings: dict[str, Any],
    root: str,
    here: str,
    real: str | None = None,
) -> dict[str, str]:
    """The files of a trainer for a mixture.

    Args:
        trainer: one of ``TRAINERS``.
        task: "segmentation" or "detection".
        settings: of the mixture, as ``read_settings`` reads them.
        root: folder of the real scans.
        here: folder in which the files will lie.
        real: what opens the real scans, as Python; by default their folder, of which its split
            "train" is opened if it has one.

    Returns:
        {name: text}; the first one is the mixture.

    Raises:
        ConfigError: on an unknown trainer, or a task that it is not connected for.
    """
    if task not in tasks_of(trainer):
        able = [name for name, known in TRAINERS.items() if task in known]
        raise ConfigError(
            f"--trainer {trainer} for {task}", f"one of {', '.join(able)}"
        )
    if Path(root, "dataset/sequences").is_dir():
        root += "/dataset"
    in_sed = re.sub(r"[\\&|]", r"\\\g<0>", _escape(root))
    in_sed = in_sed.replace("'", r"'\''")
    words = {"REAL": real or _training_scans(root), '"SED': f'"{in_sed}'}
    for word, path in {"ROOT": root, "MIX": f"{here}/{MIX}", "HERE": here}.items():
        words |= {word: shlex.quote(path), f'"{word}': f'"{_escape(path)}'}
    files = {MIX: write_mixture(settings)}
    for name, text in TRAINERS[trainer][task].items():
        files[name] = _WORDS.sub(lambda found: words[found[0]], text)
    return files


def _escape(path: str) -> str:
    """A path within a string of Python or YAML, in double quotation marks."""
    return json.dumps(path, ensure_ascii=False)[1:-1]


def _training_scans(root: str) -> str:
    """What opens the split "train" of a folder, as Python; the folder if it has no splits."""
    try:
        open_scans(root, split="train")
    except LidarSynthError:
        return repr(root)
    return f'open_scans({root!r}, split="train")'


def write_files(files: dict[str, str], folder: Path) -> None:
    """Write configurations into a folder."""
    for name, text in files.items():
        write_file(folder / name, text.encode(errors="surrogateescape"))
