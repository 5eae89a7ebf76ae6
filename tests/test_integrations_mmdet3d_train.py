# ruff: noqa: E402 - imports wait for what they need
"""MMDetection3D's own ``tools/train.py`` with its own validation, as a user types it.

Stock networks at stock size on a few scans; a CPU does not show mixed precision, several GPUs, or
that metrics improve. ``tools/try_trainers.py --only mmdetection3d`` runs more configurations, on
real scans where there are some.
"""

import os
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

for module in ("mmengine", "mmcv", "mmdet3d"):
    if find_spec(module) is None:
        pytest.skip(
            f"{module} is not installed: bash tools/install_mmdet3d.sh VENV --ops",
            allow_module_level=True,
        )
if find_spec("mmcv._ext") is None:
    pytest.skip(
        "mmcv has no operators: bash tools/install_mmdet3d.sh VENV --ops",
        allow_module_level=True,
    )

from streets import kitti, synthetic

SCRIPTS = Path(__file__).parent.parent / "tools" / "trainers" / "scripts"
TRAINER = Path(find_spec("mmdet3d").origin or "").parent  # type: ignore[union-attr]
TRAIN = TRAINER / ".mim" / "tools" / "train.py"


ENVIRONMENT = {"PYTHONPATH": str(SCRIPTS), "NUMBA_ENABLE_CUDASIM": "1"}
"""KITTI's metrics are kernels for CUDA by numba, which simulates them on a CPU if it is asked
to."""


def typed(folder: Path, *command: object) -> str:
    """The output of a command that a user types in a folder."""
    done = subprocess.run(
        [sys.executable, *map(str, command)],
        cwd=folder,
        env=os.environ | ENVIRONMENT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, (done.stdout + done.stderr)[-3000:]
    return done.stdout + done.stderr


def samples(output: str) -> list[str]:
    return [line for line in output.splitlines() if line.startswith("samples ")]


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_pointpillars_trains_validates_and_resumes(tmp_path: Path) -> None:
    """Stock PointPillars: its loss is finite, KITTI's metrics are printed, and a resumed run sees
    the same samples."""
    root = kitti(tmp_path / "kitti", 4)
    (root / "ImageSets" / "val.txt").write_text("000003\n")
    (root / "ImageSets" / "train.txt").write_text("000000\n000001\n000002\n")
    synthetic(tmp_path / "synthetic", 4)
    typed(
        tmp_path,
        SCRIPTS / "mmdet3d_prepare.py",
        tmp_path,
        "--kitti",
        root,
        "pointpillars_kitti.py",
    )
    whole = typed(tmp_path, TRAIN, "pointpillars_kitti.py", "--work-dir", "whole")
    losses = [float(text) for text in re.findall(r"Iter\(train\).* loss: (\S+)", whole)]
    assert len(losses) == 4 and all(0 < loss < 100 for loss in losses)
    assert (
        re.search(r"Car_3D_AP40_moderate_strict: \d", whole)
        and (tmp_path / "whole" / "iter_4.pth").is_file()
    )
    # Real scans by their files, synthetic ones by their ids.
    names = [line.split()[-1] for line in samples(whole)]
    assert {name.endswith(".bin") for name in names} == {False, True}
    load = ("--resume", "whole/iter_2.pth", "--work-dir", "resumed")
    assert (
        samples(typed(tmp_path, TRAIN, "pointpillars_kitti.py", *load))
        == samples(whole)[2:]
    )
