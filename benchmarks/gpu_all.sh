#!/usr/bin/env bash
# Builds with the machine's own compilers, runs the CUDA tests and then the benchmarks of suite.py on one NVIDIA GPU.
# Usage: benchmarks/gpu_all.sh [--built] [--no-tests] [OPTIONS OF suite.py]
#   --built      the libraries in gsplat_core/ are there already
#   --no-tests   do not run the CUDA tests
# gsplat is compared where Python finds it (peers/build_gsplat.py). PYTHON names another interpreter than python3, INTRASPLAT_RECORDINGS the
# folder of the real recordings. gpu_sanitize.sh runs compute-sanitizer.
set -euo pipefail
cd "$(dirname "$0")/.."
built= tests=1
while [ $# -gt 0 ]; do
  case $1 in
    --built) built=1; shift ;;
    --no-tests) tests=; shift ;;
    *) break ;;
  esac
done
nvidia-smi --query-gpu=name,driver_version,clocks.sm,clocks.mem --format=csv
[ -n "$built" ] || benchmarks/gpu_build.sh
[ -z "$tests" ] || benchmarks/gpu_tests.sh
exec "${PYTHON:-python3}" benchmarks/suite.py --device cuda "$@"
