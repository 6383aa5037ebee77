#!/usr/bin/env bash
# Build the CPU and CUDA kernels with this machine's nvcc, cmake, ninja and python3 (torch >= 2.11), without installing anything. PYTHON and CUDACXX
# select other programs, INTRASPLAT_CUDA_ARCHITECTURES other GPUs than the local one.
set -euo pipefail
cd "$(dirname "$0")/.."
python=${PYTHON:-python3}
export CUDACXX=${CUDACXX:-$(command -v nvcc || echo /usr/local/cuda/bin/nvcc)}
cmake -S . -B build/gpu_check -G Ninja -DINTRASPLAT_INPLACE=ON -DINTRASPLAT_CUDA=ON -DPython_EXECUTABLE="$(command -v "$python")" \
  -DINTRASPLAT_CUDA_ARCHITECTURES="${INTRASPLAT_CUDA_ARCHITECTURES:-native}" > /dev/null
time cmake --build build/gpu_check
