#!/usr/bin/env bash
# Run the four tools of compute-sanitizer on the tests of sanitized_tests.txt, which launch every kernel on small inputs (selected by
# gpu_kernels_reached.py). Fails if a tool reports an error in a kernel of this project, a test fails, or a tool exceeds LIMIT seconds (240). Needs the
# built kernels (benchmarks/gpu_build.sh or `make cuda`), pytest and compute-sanitizer. TOOLS selects tools; arguments are passed to pytest.
set -uo pipefail
cd "$(dirname "$0")/.."
python=${PYTHON:-python3}
sanitizer=${COMPUTE_SANITIZER:-$(command -v compute-sanitizer || echo /usr/local/cuda/bin/compute-sanitizer)}
export PYTHONPATH=$PWD${PYTHONPATH:+:$PYTHONPATH} FAIL_WITHOUT_CUDA=1
mapfile -t tests < benchmarks/sanitized_tests.txt
failed=0
for tool in ${TOOLS:-memcheck initcheck racecheck synccheck}; do
  cache=0
  [ "$tool" = memcheck ] || [ "$tool" = initcheck ] && cache=1
  # Torch's kernels are excluded to save time, except for initcheck, which must see what they write.
  skip="--kernel-name-exclude kernel_substring=_ZN2at6native"
  [ "$tool" = initcheck ] && skip=
  start=$SECONDS
  log=$(mktemp)
  PYTORCH_NO_CUDA_MEMORY_CACHING=$cache timeout "${LIMIT:-240}" "$sanitizer" --tool "$tool" --error-exitcode 9 --print-limit 20 \
    $skip \
    "$python" -m pytest -m cuda -p no:cacheprovider "${tests[@]}" "$@" > "$log" 2>&1
  rc=$?
  if [ "$rc" -ne 0 ]; then
    failed=1
    grep -v '^SKIPPED' "$log" | grep -v 'Host Frame' | head -n 60
  fi
  echo "$tool: $([ "$rc" -eq 0 ] && echo clean || echo "FAILED ($rc)") in $((SECONDS - start)) s;" \
    "$(grep -E '[0-9]+ passed|ERROR SUMMARY|RACECHECK SUMMARY|deselected' "$log" | tr '\n' ' ')"
  rm -f "$log"
done
exit "$failed"
