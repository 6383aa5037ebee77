#!/usr/bin/env bash
# Run the CUDA tests, split over several processes. Each process has its own folder for compiled extensions.
# Usage: benchmarks/gpu_tests.sh [ARGUMENTS OF pytest]; PROCESSES defaults to 8. Logs are written to out/gpu_tests.
set -uo pipefail
cd "$(dirname "$0")/.."
export PYTHONPATH=$PWD${PYTHONPATH:+:$PYTHONPATH} FAIL_WITHOUT_CUDA=1 OMP_NUM_THREADS=2
processes=${PROCESSES:-8}
mkdir -p out/gpu_tests
mapfile -t files < <(grep -rlE "cuda|gpu|device" tests/gsplat_core tests/operators --include='test_*.py' | sort)
pids=()
for ((part = 0; part < processes; part++)); do
  chosen=()
  for ((index = part; index < ${#files[@]}; index += processes)); do chosen+=("${files[index]}"); done
  TORCHINDUCTOR_CACHE_DIR=$(mktemp -d) TORCH_EXTENSIONS_DIR=$(mktemp -d) \
    "${PYTHON:-python3}" -m pytest -m cuda -p no:cacheprovider "$@" "${chosen[@]}" > "out/gpu_tests/$part.log" 2>&1 &
  pids+=($!)
done
failed=0
for ((part = 0; part < processes; part++)); do
  wait "${pids[part]}"
  code=$?
  tail -n 1 "out/gpu_tests/$part.log"
  if [ "$code" -ne 0 ] && [ "$code" -ne 5 ]; then
    failed=1
    grep -E "^(FAILED|ERROR)" "out/gpu_tests/$part.log"
  fi
done
exit "$failed"
