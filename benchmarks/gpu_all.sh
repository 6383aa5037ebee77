#!/usr/bin/env bash
# Build with the machine's compilers, then run the CUDA tests and the benchmarks of suite.py on one NVIDIA GPU.
# Usage: benchmarks/gpu_all.sh [--built] [--no-tests] [OPTIONS OF suite.py]
#   --built      use the libraries in gsplat_core/
#   --no-tests   do not run the CUDA tests
# gsplat is compared if it can be imported (peers/build_gsplat.py). PYTHON is the interpreter (default python3), INTRASPLAT_RECORDINGS the folder of the
# real recordings. gpu_sanitize.sh runs compute-sanitizer.
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
