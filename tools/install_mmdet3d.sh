#!/usr/bin/env bash
# Installs MMDetection3D 1.4.0 from the package index into a virtual environment that has lidar_synth.
#
#   bash tools/install_mmdet3d.sh VENV                    datasets and transforms, without training (a minute)
#   bash tools/install_mmdet3d.sh VENV --ops              training and evaluation: mmcv's operators too, compiled for the
#                                                         CPU (half an hour)
#   bash tools/install_mmdet3d.sh VENV --ops WHEEL        the same from a wheel of mmcv 2.1.0; or MMCV_WHEEL=WHEEL
#
# An extra of the package cannot do this: nuscenes-devkit pins numpy < 2, so it is installed without its dependencies, and
# mmdet3d, mmdet and mmengine require libraries that nothing here uses. numpy 2.4 works.
set -euo pipefail

venv="${1:?usage: install_mmdet3d.sh VENV [--ops [WHEEL]]}"
wheel="${3:-${MMCV_WHEEL:-}}"
python="$venv/bin/python"
"$python" -c 'import torch' 2>/dev/null || { echo "$venv has no torch: install lidar_synth first"; exit 1; }
[ -z "$wheel" ] || [ -f "$wheel" ] || { echo "$wheel is not a file: expected a wheel of mmcv 2.1.0"; exit 1; }
freeze="$(mktemp)"
trap 'rm -f "$freeze"' EXIT
"$python" -m pip list --format=freeze | grep -iE '^(numpy|torch)==' > "$freeze"
pip() { "$python" -m pip install --disable-pip-version-check --quiet --constraint "$freeze" "$@"; }

pip --no-deps mmengine==0.10.7 mmdet==3.3.0 mmdet3d==1.4.0 nuscenes-devkit==1.2.0 lyft_dataset_sdk==0.0.8
# Headless: the other build of OpenCV needs libGL.
pip --no-deps opencv-python-headless
# pandas: lyft_dataset_sdk, which mmdet3d's evaluation imports. setuptools: mmengine imports its pkg_resources. Without
# torch's wheel of torchvision mmengine still works.
pip --only-binary :all: addict yapf termcolor regex rich terminaltables shapely six pycocotools trimesh plyfile \
    scikit-image scikit-learn scipy pyquaternion cachetools fire packaging prettytable pandas 'setuptools<80'

if [ "${2:-}" = --ops ]; then
    "$python" -m pip uninstall --yes --quiet mmcv-lite
    if [ -n "$wheel" ]; then
        pip --no-deps "$wheel"
    else
        pip wheel ninja
        MMCV_WITH_OPS=1 FORCE_CUDA=0 pip --no-deps --no-build-isolation mmcv==2.1.0
    fi
else
    pip --no-deps mmcv-lite==2.1.0
fi

# What training with evaluation imports, so that something missing shows here and not after the first epoch.
"$python" - "${2:-}" <<'CHECK'
import sys
from importlib.metadata import version

from mmengine.utils import is_installed  # what reads a stock configuration

assert is_installed("mmdet3d")
if sys.argv[1] == "--ops":
    import mmdet3d.apis, mmdet3d.datasets, mmdet3d.evaluation, mmdet3d.models, mmdet3d.visualization  # noqa: E401, F401
    import nuscenes.eval.detection.evaluate  # noqa: F401
print(*(f"{name} {version(name)}" for name in ("mmengine", "mmdet", "mmdet3d", "mmcv", "numpy", "torch") if name != "mmcv" or sys.argv[1]), sep=", ")
CHECK
