#!/usr/bin/env bash
# Builds the CPU's and the CUDA kernels with what this machine has (nvcc, cmake, ninja, a python3 with torch >= 2.11 and pytest),
# without installing anything, and runs the CUDA tests. Arguments go to pytest.
set -euo pipefail
cd "$(dirname "$0")/.."
python=${PYTHON:-python3}
export PYTHONPATH=$PWD CUDACXX=${CUDACXX:-$(command -v nvcc || echo /usr/local/cuda/bin/nvcc)} FAIL_WITHOUT_CUDA=1
cmake -S . -B build/gpu_check -G Ninja -DINTRASPLAT_INPLACE=ON -DINTRASPLAT_CUDA=ON -DPython_EXECUTABLE="$(command -v "$python")" \
  -DINTRASPLAT_CUDA_ARCHITECTURES="${INTRASPLAT_CUDA_ARCHITECTURES:-native}"
time cmake --build build/gpu_check
"$python" -m pytest -m cuda tests/gsplat_core/cuda "$@"
