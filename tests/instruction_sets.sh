#!/usr/bin/env bash
# Run the numeric tests with each instruction set of this processor: of torch's kernels (ATEN_CPU_CAPABILITY), of torch's BLAS
# (MKL_ENABLE_INSTRUCTIONS; ignored on other processors than Intel's), of NumPy's BLAS (OPENBLAS_CORETYPE) and of the kernels here
# (INTRASPLAT_ISA). Usage: tests/instruction_sets.sh [TEST FILES OR FOLDERS]; without arguments the fast tests of the core and the operators.
# Environment: PROCESSES (default 2, over which the files are split) and PYTHON. Logs are written to out/instruction_sets.
set -uo pipefail
cd "$(dirname "$0")/.."
export OMP_WAIT_POLICY=PASSIVE OMP_NUM_THREADS="${OMP_NUM_THREADS:-1}" OPENBLAS_NUM_THREADS=1 OPENCV_FOR_THREADS_NUM=1
python=${PYTHON:-.venv/bin/python}
processes=${PROCESSES:-2}
logs=out/instruction_sets
mkdir -p "$logs"
mapfile -t files < <(find "${@:-tests/gsplat_core}" $([ $# -gt 0 ] || echo tests/operators) -name 'test_*.py' | sort)

run_tests() {  # NAME VARIABLE=VALUE...: the tests with these settings; false where one fails
  local name=$1 pids=() part index failed=0
  shift
  for ((part = 0; part < processes; part++)); do
    local chosen=()
    for ((index = part; index < ${#files[@]}; index += processes)); do chosen+=("${files[index]}"); done
    [ ${#chosen[@]} -gt 0 ] || continue
    env "$@" TORCHINDUCTOR_CACHE_DIR="$(mktemp -d)" TORCH_EXTENSIONS_DIR="$(mktemp -d)" \
      "$python" -m pytest -p no:cacheprovider -m "not slow" "${chosen[@]}" > "$logs/$name.$part.log" 2>&1 &
    pids+=($!)
  done
  for ((part = 0; part < ${#pids[@]}; part++)); do
    wait "${pids[part]}"
    local code=$?
    tail -n 1 "$logs/$name.$part.log"
    if [ "$code" -ne 0 ] && [ "$code" -ne 5 ]; then  # 5: all of its tests are slow
      failed=1
      grep -E "^(FAILED|ERROR) " "$logs/$name.$part.log"
    fi
  done
  return $failed
}

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
  echo "== $set: ${settings[*]}"
  run_tests "$set" "${settings[@]}" || failed+=("$set")
done
[ ${#failed[@]} -eq 0 ] || { echo "failed with: ${failed[*]}"; exit 1; }
