#!/usr/bin/env bash
# Run the CUDA tests and the benchmarks of the splatting methods on one NVIDIA GPU, timed ones first and alone.
# Usage: benchmarks/gpu_methods.sh OUT [OLD_TREE OLD_COMMIT]
#   OUT          folder of the logs
#   OLD_TREE     source tree of an older commit, built here too; rendering, replay and live are compared with it (methods/unchanged.py)
# gsplat is compared if GSPLAT_WHEEL names its wheel (peers/build_gsplat.py), which is then compiled first. PYTHON is the interpreter (default python3),
# INTRASPLAT_RECORDINGS the folder of the real recordings. Each benchmark prints to OUT/NAME.txt; one that fails does not stop the others.
set -uo pipefail
cd "$(dirname "$0")/.."
out=$(realpath -m "$1") old=${2:-} old_commit=${3:-}
python=${PYTHON:-python3}
mkdir -p "$out"
export PYTHONPATH=$PWD${PYTHONPATH:+:$PYTHONPATH} PYTHONUNBUFFERED=1
began=$SECONDS

# Run the script METHOD with the given options. Its log and its printed lines are OUT/NAME.json and OUT/NAME.txt.
method() {
  local name=$1 script=$2 start=$SECONDS code=0
  shift 2
  "$python" "benchmarks/methods/$script.py" --device cuda "$@" --out "$out/$name.json" > "$out/$name.txt" 2>&1 || code=$?
  echo "$name: exit code $code after $((SECONDS - start)) s, at $((SECONDS - began)) s" | tee -a "$out/progress.txt"
}

compiled=
benchmarks/gpu_build.sh > "$out/build.txt" 2>&1 || exit
if [ -n "$old" ]; then
  "$old/benchmarks/gpu_build.sh" > "$out/build-old.txt" 2>&1 &
  compiled+=" $!"
fi
if [ -n "${GSPLAT_WHEEL:-}" ]; then
  "$python" benchmarks/peers/build_gsplat.py "$GSPLAT_WHEEL" build/peers > "$out/build-gsplat.txt" 2>&1 &
  compiled+=" $!"
fi
benchmarks/gpu_tests.sh > "$out/tests.txt" 2>&1
echo "tests: exit code $?, at $((SECONDS - began)) s" | tee -a "$out/progress.txt"
# shellcheck disable=SC2086 # a list of numbers
[ -z "$compiled" ] || wait $compiled
echo "compiled at $((SECONDS - began)) s" | tee -a "$out/progress.txt"

PYTHONPATH=$PWD/build/peers:$PYTHONPATH method stochastic-cuda stochastic --full
method weighted_sum-cuda weighted_sum --full --steps 1500 --recording "$INTRASPLAT_RECORDINGS/cutting"
method pretrained-cuda pretrained --full
method surface-step-cuda surface step --full
[ -z "$old" ] || method unchanged-cuda unchanged "$old" --old-commit "$old_commit"

# Quality only: these share the GPU, and end before the step times that `training` measures at its end.
{
  method surface-stereo-cuda surface stereo --full --seeds 3 --losses ray_depth,normal_consistency ray_depth,normal_consistency:0.3
  method surface-cuda surface wall semantics --full
} &
beside=$!
{
  method triangulation-cuda triangulation --full
  method growth-cuda growth --full
  method regression-cuda regression --full
  method range_sensors-cuda range_sensors --full
  method flow-cuda flow --full --cases stereo
} &
beside+=" $!"
method training-cuda training --full --steps 1000 --together 2
# shellcheck disable=SC2086
wait $beside
