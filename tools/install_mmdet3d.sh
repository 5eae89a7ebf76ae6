#!/usr/bin/env bash
# Installs MMDetection3D 1.4.0 from the package index into a virtual environment that has lidar_synth.
#
#   bash tools/install_mmdet3d.sh .venv                what datasets and transforms need (a minute)
#   bash tools/install_mmdet3d.sh .venv --ops          also mmcv's operators, compiled for the CPU (half an hour)
#   MMCV_WHEEL=mmcv-2.1.0-....whl bash tools/install_mmdet3d.sh .venv --ops     the same from a wheel
#
# An extra of the package cannot do this: nuscenes-devkit pins numpy < 2, so it is installed without its dependencies, and
# mmdet3d, mmdet and mmengine require libraries that nothing here uses. numpy 2.4 works.
set -euo pipefail

venv="${1:?usage: install_mmdet3d.sh VENV [--ops]}"
python="$venv/bin/python"
"$python" -c 'import torch' 2>/dev/null || { echo "$venv has no torch: install lidar_synth first"; exit 1; }
freeze="$(mktemp)"
trap 'rm -f "$freeze"' EXIT
"$python" -m pip list --format=freeze | grep -iE '^(numpy|torch)==' > "$freeze"
pip() { "$python" -m pip install --disable-pip-version-check --quiet --constraint "$freeze" "$@"; }

pip --no-deps mmengine==0.10.7 mmdet==3.3.0 mmdet3d==1.4.0 nuscenes-devkit==1.2.0 lyft_dataset_sdk==0.0.8
# Headless: the other build of OpenCV needs libGL.
pip --no-deps opencv-python-headless
pip --only-binary :all: addict yapf termcolor regex rich terminaltables shapely six pycocotools trimesh plyfile \
    scikit-image scikit-learn scipy pyquaternion cachetools fire packaging prettytable

if [ "${2:-}" = --ops ]; then
    "$python" -m pip uninstall --yes --quiet mmcv-lite
    if [ -n "${MMCV_WHEEL:-}" ]; then
        pip --no-deps "$MMCV_WHEEL"
    else
        pip 'setuptools<80' wheel ninja
        MMCV_WITH_OPS=1 FORCE_CUDA=0 pip --no-deps --no-build-isolation mmcv==2.1.0
    fi
else
    pip --no-deps mmcv-lite==2.1.0
fi

"$python" - <<'CHECK'
from importlib.metadata import version
print(*(f"{name} {version(name)}" for name in ("mmengine", "mmdet", "mmdet3d", "numpy", "torch")), sep=", ")
CHECK
