#!/usr/bin/env bash
# compute-sanitizer's four tools over the tests of sanitized_tests.txt, which together launch every kernel on small inputs
# (gpu_kernels_reached.py chose them). Fails when a tool finds something in a kernel of ours, or a test fails, or a tool takes
# longer than LIMIT seconds (240). Needs the built kernels (benchmarks/gpu_build.sh or `make cuda`), pytest and
# compute-sanitizer; TOOLS names others than all tools, arguments go to pytest.
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
  # torch's own kernels take time and are not ours to check, but initcheck has to see what they write.
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
