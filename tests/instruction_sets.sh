#!/usr/bin/env bash
# Runs the numeric tests with each instruction set of this processor: that of torch's kernels (ATEN_CPU_CAPABILITY), of torch's BLAS
# (MKL_ENABLE_INSTRUCTIONS; MKL ignores it on processors that are not Intel's), of numpy's BLAS (OPENBLAS_CORETYPE) and of our kernels
# (INTRASPLAT_ISA). Arguments are passed to pytest in place of the numeric tests.
set -uo pipefail
cd "$(dirname "$0")/.."
export OMP_WAIT_POLICY=PASSIVE OMP_NUM_THREADS="${OMP_NUM_THREADS:-1}" OPENBLAS_NUM_THREADS=1 OPENCV_FOR_THREADS_NUM=1
tests=("$@")
[ $# -gt 0 ] || tests=(-m "not slow" tests/gsplat_core tests/operators)
failed=()
for set in baseline avx2 avx512 widest; do
  case $set in
    baseline) settings=(ATEN_CPU_CAPABILITY=default MKL_ENABLE_INSTRUCTIONS=SSE4_2 OPENBLAS_CORETYPE=Nehalem INTRASPLAT_ISA=baseline) ;;
    avx2) settings=(ATEN_CPU_CAPABILITY=avx2 MKL_ENABLE_INSTRUCTIONS=AVX2 OPENBLAS_CORETYPE=Haswell INTRASPLAT_ISA=avx2) ;;
    avx512)
      grep -qw avx512f /proc/cpuinfo || { echo "avx512: not on this processor"; continue; }
      settings=(ATEN_CPU_CAPABILITY=avx512 MKL_ENABLE_INSTRUCTIONS=AVX512 OPENBLAS_CORETYPE=SkylakeX INTRASPLAT_ISA=avx512) ;;
    widest) settings=(OPENBLAS_CORETYPE=Zen) ;;  # torch and our kernels as they choose
  esac
  echo "== ${settings[*]}"
  env "${settings[@]}" .venv/bin/python -m pytest "${tests[@]}" || failed+=("$set")
done
[ ${#failed[@]} -eq 0 ] || { echo "failed with: ${failed[*]}"; exit 1; }
