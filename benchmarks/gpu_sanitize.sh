#!/usr/bin/env bash
# compute-sanitizer's four tools over those CUDA tests that together launch every kernel on small inputs. Fails when a tool finds
# something in a kernel of ours, or a test fails, or a tool takes longer than LIMIT seconds (100). Needs the built kernels
# (benchmarks/gpu_check.sh or `make cuda`), pytest and compute-sanitizer; TOOLS and SELECTION name others than all tools and the
# tests below, further arguments go to pytest.
set -uo pipefail
cd "$(dirname "$0")/.."
python=${PYTHON:-python3}
sanitizer=${COMPUTE_SANITIZER:-$(command -v compute-sanitizer || echo /usr/local/cuda/bin/compute-sanitizer)}
export PYTHONPATH=$PWD${PYTHONPATH:+:$PYTHONPATH} FAIL_WITHOUT_CUDA=1
# Every op has an opcheck, forward and backward; the others reach template variants, long lists, large splats and odd sizes. Graphs
# are left out: a capture cannot allocate without torch's cache, which memcheck and initcheck are run without.
selection=${SELECTION:-"(opcheck or sets_are_copied or large_splats or lists_of_a_capacity or any_number_of_channels \
or any_tile_and_image_size or test_ops_pass or every_degree or very_many or fused_adam_is or adam_is_the_gradient \
or (equals_the_reference and not 5000) or (values_and_gradients and not 1100)) and not graph and not captured"}
failed=0
for tool in ${TOOLS:-memcheck initcheck racecheck synccheck}; do
  cache=0
  [ "$tool" = memcheck ] || [ "$tool" = initcheck ] && cache=1
  # Racecheck follows every access to shared memory: it gets the small inputs only.
  [ "$tool" = racecheck ] && tests="($selection) and not very_many and not any_tile and not any_number and not fused_adam_is" || tests=$selection
  # torch's own kernels take time and are not ours to check, but initcheck has to see what they write.
  skip="--kernel-name-exclude kernel_substring=_ZN2at6native"
  [ "$tool" = initcheck ] && skip=
  start=$SECONDS
  log=$(mktemp)
  PYTORCH_NO_CUDA_MEMORY_CACHING=$cache timeout "${LIMIT:-100}" "$sanitizer" --tool "$tool" --error-exitcode 9 --print-limit 20 \
    $skip \
    "$python" -m pytest -m cuda tests/gsplat_core/cuda -k "$tests" -p no:cacheprovider "$@" > "$log" 2>&1
  rc=$?
  if [ "$rc" -ne 0 ]; then
    failed=1
    grep -v '^SKIPPED' "$log" | head -n 60
  fi
  echo "$tool: $([ "$rc" -eq 0 ] && echo clean || echo "FAILED ($rc)") in $((SECONDS - start)) s;" \
    "$(grep -E '[0-9]+ passed|ERROR SUMMARY|RACECHECK SUMMARY|deselected' "$log" | tr '\n' ' ')"
  rm -f "$log"
done
exit "$failed"
