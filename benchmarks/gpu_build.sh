#!/usr/bin/env bash
# Builds the CPU's and the CUDA kernels with what this machine has (nvcc, cmake, ninja, a python3 with torch >= 2.11), without
# installing anything. PYTHON and CUDACXX name other programs; INTRASPLAT_CUDA_ARCHITECTURES names other GPUs than the one at hand.
set -euo pipefail
cd "$(dirname "$0")/.."
python=${PYTHON:-python3}
export CUDACXX=${CUDACXX:-$(command -v nvcc || echo /usr/local/cuda/bin/nvcc)}
cmake -S . -B build/gpu_check -G Ninja -DINTRASPLAT_INPLACE=ON -DINTRASPLAT_CUDA=ON -DPython_EXECUTABLE="$(command -v "$python")" \
  -DINTRASPLAT_CUDA_ARCHITECTURES="${INTRASPLAT_CUDA_ARCHITECTURES:-native}" > /dev/null
time cmake --build build/gpu_check
