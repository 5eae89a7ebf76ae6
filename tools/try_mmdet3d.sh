#!/usr/bin/env bash
# Trains stock PointPillars (KITTI) and FRNet (SemanticKITTI) for a few iterations on the CPU, on a mixture of real scans
# and scans of the town. Without --kitti and --semantic-kitti, another town takes the place of the real scans.
#
#   bash tools/install_mmdet3d.sh .venv --ops
#   FRNET_ROOT=/path/to/FRNet bash tools/try_mmdet3d.sh .venv OUT [--iterations 4] [--scans 8] [--batch-size 2] \
#       [--kitti /data/kitti] [--semantic-kitti /data/SemanticKITTI/dataset]
#
# FRNet has its own repository (github.com/Xiangxu-0103/FRNet). If torch_scatter is not installed, tools/stand_ins provides
# the two functions of it that FRNet calls.
set -euo pipefail

venv="${1:?usage: try_mmdet3d.sh VENV OUT [OPTIONS]}"
here="$(cd "$(dirname "$0")" && pwd)"
shift
path="${PYTHONPATH:-}"
if [ -n "${FRNET_ROOT:-}" ]; then
    path="$FRNET_ROOT:$path"
    "$venv/bin/python" -c 'import torch_scatter' 2>/dev/null || path="$here/stand_ins:$path"
fi
export FRNET_ROOT="${FRNET_ROOT:-}"
PYTHONPATH="$path" exec "$venv/bin/python" "$here/try_mmdet3d.py" "$@"
