#!/usr/bin/env bash
# Build, run the CUDA tests, and measure every recording with default settings, and four rooms, on one or two NVIDIA GPUs.
# Usage: benchmarks/gpu_generality.sh OUT [RUNS]
#   OUT    folder of the logs; OUT/cuda.jsonl is the log for benchmarks/logs/generality, OUT/rooms_cutting*.jsonl for logs/cuda,
#          OUT/paths.jsonl has the durations of estimated paths on this host's CPU, OUT/setup.jsonl those before the first step offline
#   RUNS   runs of each command (default 3)
# PARTS names the parts of this call (default: build tests rooms paths setup offline live live_own_rate), for a GPU that is at hand for a shorter time;
# one call must build. Parts of several calls at one commit with the same OUT make one log.
# INTRASPLAT_RECORDINGS is the folder of the recordings, PYTHON the interpreter (default python3). With two GPUs, live runs have the
# first GPU and half of the processor cores for themselves; tests and most offline runs take the other half at the same time.
set -uo pipefail
cd "$(dirname "$0")/.."
out=$(realpath -m "$1") runs=${2:-3} recordings=$(realpath "${INTRASPLAT_RECORDINGS:?names the folder of the recordings}")
python=${PYTHON:-python3}
# Offline recordings that the first GPU takes before its live runs: those whose choice of poses takes the longest, and the shortest.
first=(others/laparoscopy others/resting_bowel others/organ_still)
mkdir -p "$out"
parts=" ${PARTS:-build tests rooms paths setup offline live live_own_rate} "
# Compiled modules are cached even if the interpreter's own folder is read-only; otherwise every command compiles them again.
export PYTHONPYCACHEPREFIX=${PYTHONPYCACHEPREFIX:-/tmp/intrasplat-pycache}
export PYTHONPATH=$PWD${PYTHONPATH:+:$PYTHONPATH} PYTHONUNBUFFERED=1
unset PYTHONDONTWRITEBYTECODE

# Run a function if its part is wanted: do_part PART FUNCTION
do_part() { if [[ $parts == *" $1 "* ]]; then "$2"; fi; }
build() { benchmarks/gpu_build.sh > "$out/build.txt" 2>&1; }

measure() {
  local name=$1
  shift
  "$python" benchmarks/generality.py "$recordings" --device cuda --runs "$runs" --out "$out/$name.part.jsonl" "$@" >> "$out/$name.txt" 2>&1
}
two_gpu_tests() {  # those that need a second GPU, which each half of the machine lacks
  "$python" -m pytest -m cuda -rs tests/gsplat_core/cuda/test_{distributed,second_device,plain_chain}.py > "$out/tests_two.txt" 2>&1
}
tests() { benchmarks/gpu_tests.sh > "$out/tests.txt" 2>&1; }
live() { measure live --parts live; }
live_own_rate() { measure live_own_rate --parts live_own_rate; }
others() {
  mapfile -t names < <("$python" -c 'import sys; sys.path.insert(0, "benchmarks"); import generality, pathlib
print(*(name for name in generality.recordings(pathlib.Path(sys.argv[1])) if name not in sys.argv[2:]), sep="\n")' "$recordings" "${first[@]}")
  measure offline --parts offline --only "${names[@]}"
}
rooms() { "$python" benchmarks/suite.py --device cuda --only rooms_cutting rooms_cutting_mps --out "$out" > "$out/rooms.txt" 2>&1; }
setup() {
  "$python" benchmarks/offline_setup.py "$recordings"/others/{laparoscopy,resting_bowel}/video.mp4 --device cuda > "$out/setup.jsonl" 2> "$out/setup.txt"
}
paths() {
  "$python" benchmarks/offline_poses.py "$recordings"/others/{laparoscopy,resting_bowel}/video.mp4 --runs 1 > "$out/paths.jsonl" 2> "$out/paths.txt"
}
first() { measure offline_first --parts offline --only "${first[@]}"; }

do_part build build || exit 1
if [ "$(nvidia-smi --list-gpus | wc -l)" -gt 1 ]; then
  half=$(($(nproc) / 2))
  (export CUDA_VISIBLE_DEVICES=1; taskset -cp "$half-$((2 * half - 1))" "$BASHPID" > /dev/null
    do_part tests tests; do_part rooms rooms; do_part paths paths; do_part offline others) &
  beside=$!
  (export CUDA_VISIBLE_DEVICES=0; taskset -cp "0-$((half - 1))" "$BASHPID" > /dev/null
    do_part offline first; do_part setup setup; do_part live live; do_part live_own_rate live_own_rate)
  wait "$beside"
  do_part tests two_gpu_tests
else
  do_part tests tests; do_part rooms rooms; do_part paths paths; do_part setup setup
  do_part offline first; do_part offline others; do_part live live; do_part live_own_rate live_own_rate
fi
for name in live live_own_rate offline offline_first; do
  if [ -f "$out/$name.part.jsonl" ]; then cat "$out/$name.part.jsonl"; fi
done > "$out/cuda.jsonl"
