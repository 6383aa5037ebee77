#!/usr/bin/env bash
# Everything that is to be shown on one NVIDIA GPU, in one go: build, CUDA tests, benchmarks beside the peers.
# Usage: benchmarks/gpu_all.sh [--built] [--sanitize] [FOLDER FOR THE OUTPUT, default out/gpu]
#   --built     the libraries in gsplat_core/ are there already; neither build nor test
#   --sanitize  also compute-sanitizer's four tools over the tests that gpu_sanitize.sh selects
# gsplat is compared where Python finds it (peers/build_gsplat.py); PYTHON names another interpreter than python3, RECORDINGS the folder
# of the real recordings, without which nothing is replayed.
set -euo pipefail
cd "$(dirname "$0")/.."
built= sanitize= out=out/gpu
for argument; do
  case $argument in
    --built) built=1 ;;
    --sanitize) sanitize=1 ;;
    -*) echo "unknown option $argument; usage: benchmarks/gpu_all.sh [--built] [--sanitize] [FOLDER]" >&2; exit 2 ;;
    *) out=$argument ;;
  esac
done
python=${PYTHON:-python3}
export PYTHONPATH=$PWD${PYTHONPATH:+:$PYTHONPATH}
mkdir -p "$out"
nvidia-smi --query-gpu=name,driver_version,clocks.sm,clocks.mem --format=csv | tee "$out/machine.csv"
[ -n "$built" ] || benchmarks/gpu_check.sh
if [ -n "$sanitize" ]; then benchmarks/gpu_sanitize.sh 2>&1 | tee "$out/sanitizer.log"; fi
for name in gpu_splat gpu_eager gpu_deformation gpu_training; do
  echo "$name"
  "$python" "benchmarks/$name.py" | tee "$out/$name.jsonl"
done
if [ -d "${RECORDINGS:-}/cutting" ]; then
  echo replay_gpu
  "$python" benchmarks/replay_gpu.py "$RECORDINGS/cutting" | tee "$out/replay_gpu.jsonl"
  echo gpu_offline
  "$python" benchmarks/gpu_offline.py "$RECORDINGS/cutting" "$RECORDINGS/sinus" --fields basis hexplane --seconds 15 | tee "$out/gpu_offline.jsonl"
fi
