"""MMDetection3D from the package index: its stock ``train.py`` with validation, on KITTI,
SemanticKITTI and nuScenes.

MMCV_WHEEL names a wheel of mmcv 2.1.0 with its operators; without it they are compiled. FRNet, the
network for SemanticKITTI, runs if FRNET_ROOT names a clone of its repository: it needs
torch-scatter, which is compiled. MinkUNet cannot run on a CPU, because its voxelisation sends
tensors to CUDA.
"""

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from trainers.trial import ROOT, Failed, Row, Trial

TITLE = "MMDetection3D 1.4"
PAGE = "mmdetection3d"

SCRIPTS = Path(__file__).parent / "scripts"
ITERATIONS = 4
RUNS = {
    "pointpillars_kitti.py": r"Car_3D_AP40_moderate_strict: \d",
    "centerpoint_pillar_nuscenes.py": r"NDS: \d",
    "centerpoint_voxel_nuscenes.py": r"NDS: \d",
    "frnet_semantickitti.py": r"miou: \d",
}
"""Our configurations, and what their validation prints."""
LEFT_OUT = {
    "pointpillars_kitti.py": "KITTI's metrics are CUDA kernels: numba's simulator ran them",
    "centerpoint_voxel_nuscenes.py": "spconv asks for a CUDA stream, unused on a CPU: "
    "`scripts/spconv_on_cpu.py`",
    "frnet_semantickitti.py": "MinkUNet, whose voxelisation sends tensors to CUDA",
}
ENVIRONMENT = {"NUMBA_ENABLE_CUDASIM": "1"}
"""KITTI's metrics are kernels for CUDA by numba, which simulates them on a CPU if it is asked
to."""


def rows(trial: Trial) -> Iterator[Row]:
    """A few iterations, validation and a checkpoint of each configuration, and a resumed run."""
    python = trial.environment()
    installer = {
        "VENV": python.parent.parent,
        "tools/install_mmdet3d.sh": ROOT / "tools" / "install_mmdet3d.sh",
    }
    trial.type_page("install", python, PAGE, installer, skip="^(?!bash)", minutes=90)
    trial.install(python, "spconv")
    configs = dict(RUNS)
    env = ENVIRONMENT | {"PYTHONPATH": str(SCRIPTS)}
    if os.environ.get("FRNET_ROOT"):
        env |= {
            "PYTHONPATH": f"{SCRIPTS}:{trial.tree('FRNET_ROOT')}",
            "FRNET_ROOT": str(trial.tree("FRNET_ROOT")),
        }
        trial.install(python, "wheel")
        trial.install(python, "torch-scatter", options=["--no-build-isolation"])
    else:
        del configs["frnet_semantickitti.py"]
    prepare(trial, python, list(configs), env)
    for config, metric in configs.items():
        yield one(trial, python, config, metric, env)


def prepare(
    trial: Trial, python: Path, configs: list[str], env: dict[str, str]
) -> None:
    """Write data, lists and short configurations to the trial's folder; the page writes
    SemanticKITTI's lists."""
    nuscenes = trial.folder / "nuscenes"
    trial.run("nuScenes", [python, SCRIPTS / "nuscenes_town.py", nuscenes])
    data = ["--kitti", trial.data.kitti, "--nuscenes", nuscenes]
    frame = Path(os.environ.get("LIDAR_SYNTH_REAL_SCANS", "")) / "nuscenes"
    if (frame / "info.json").is_file():
        data += ["--frame", frame]
    command = [python, SCRIPTS / "mmdet3d_prepare.py", trial.folder, *configs, *data]
    trial.run("prepare", command, env=env)
    shutil.copytree(trial.data.semantic_kitti, trial.folder / "data" / "semantickitti")
    names = {'"bank"': repr(str(trial.data.bank))}
    trial.type_page(
        "lists",
        python,
        PAGE,
        names,
        skip="^bash|^python VENV|custom_imports|data/nuscenes",
    )


def one(
    trial: Trial, python: Path, config: str, metric: str, env: dict[str, str]
) -> Row:
    """Train with a configuration, and for the first one resume from the middle."""
    name = config.removesuffix(".py")
    ran = ["training", "validation", "checkpoint"]
    out = trial.folder / f"work-{name}"

    def train(title: str, arguments: str, expect: list[str]) -> list[str]:
        names = {"VENV": python.parent.parent, "CONFIG": f"{config} {arguments}"}
        said = trial.type_page(
            title,
            python,
            PAGE,
            names,
            skip="^(?!python VENV)",
            env=env,
            expect=expect,
            minutes=120,
        )
        return [line for line in said.splitlines() if line.startswith("samples ")]

    seen = train(name, f"--work-dir {out}", [r"loss: \d", metric])
    if len(seen) != ITERATIONS or not (out / f"iter_{ITERATIONS}.pth").is_file():
        raise Failed(
            f"{name}: {len(seen)} of {ITERATIONS} iterations, or no checkpoint; see "
            f"{trial.folder / 'logs'}"
        )
    if config == next(iter(RUNS)):
        load = (
            f"--resume {out / f'iter_{ITERATIONS // 2}.pth'} --work-dir "
            f"{trial.folder / 'work-resumed'}"
        )
        rest = train(f"{name} resumed", load, [])
        if rest != seen[ITERATIONS // 2 :]:
            raise Failed(f"{name}: the resumed run saw {rest} instead of {seen}")
        ran.append("resume")
    left_out = "; ".join(
        filter(None, ["mixed precision, several GPUs", LEFT_OUT.get(config)])
    )
    return trial.row(f"python tools/train.py {config}", ran, left_out)
