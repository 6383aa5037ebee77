#!/usr/bin/env bash
# Measures this machine: every figure of benchmarks/RESULTS.md and benchmarks/results, as JSON lines. Needs the real recordings for the replays.
# Usage: benchmarks/run_all.sh [FOLDER FOR THE OUTPUT, default out/bench]
set -euo pipefail
cd "$(dirname "$0")/.."
out=${1:-out/bench}
recordings=${INTRASPLAT_RECORDINGS:-../shared/recordings}
python=.venv/bin/python
mkdir -p "$out"
measure() {
  echo "$1"
  "$python" "benchmarks/$1.py" "${@:3}" | tee "$out/$2.json"
}
measure replay_cpu replay_cutting "$recordings/cutting"
measure replay_cpu replay_sinus "$recordings/sinus" --fields basis --engines embedded
measure graph_overhead graph --holoscan
measure frame_path_cpu frame_path "$recordings/cutting" "synthetic:?width=1280&height=1024&frames=12"
measure losses_cpu losses
measure registry_cpu registry
measure deformation_cpu deformation
measure training_cpu training
measure splat_cpu splat
