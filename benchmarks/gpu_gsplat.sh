#!/usr/bin/env bash
# Run the CUDA tests and the comparisons with gsplat on one or two NVIDIA GPUs.
# Usage: benchmarks/gpu_gsplat.sh OUT GSPLAT_WHEEL GSPLAT_SOURCES [EXAMPLES] [SCRIPT...]
#   OUT              folder of the logs
#   GSPLAT_WHEEL     gsplat-1.5.3-py3-none-any.whl, which is compiled (peers/build_gsplat.py)
#   GSPLAT_SOURCES   unpacked source archive of gsplat 1.5.3, whose tests are run with this package
#   EXAMPLES         folder with gsplat's simple_trainer.py, or "" to leave the trainer out
#   SCRIPT           further scripts of timings, run with --module gsplat and with --module gsplat_core
# Timed benchmarks run alone on their GPU. With two GPUs, the others run on the second at the same time, and processes.py on
# both. PYTHON is the interpreter (default python3). Each benchmark prints to OUT/NAME.txt; one that fails does not stop the others.
set -uo pipefail
cd "$(dirname "$0")/.."
out=$(realpath -m "$1") wheel=$(realpath "$2") sources=$(realpath "$3") examples=${4:-}
shift $(($# < 4 ? $# : 4))
python=${PYTHON:-python3}
mkdir -p "$out"
export PYTHONPATH=$PWD${PYTHONPATH:+:$PYTHONPATH} PYTHONUNBUFFERED=1
began=$SECONDS

# Run a command and return its exit code. Its output is OUT/NAME.txt.
run() {
  local name=$1 start=$SECONDS code=0
  shift
  "$@" > "$out/$name.txt" 2>&1 || code=$?
  echo "$name: exit code $code after $((SECONDS - start)) s, at $((SECONDS - began)) s" | tee -a "$out/progress.txt"
  return "$code"
}

# Run the script of benchmarks/gsplat with the given options. Its log is OUT/NAME-cuda.json.
compare() {
  local name=$1 script=$2
  shift 2
  run "$name" "$python" "benchmarks/gsplat/$script.py" "$@" --device cuda --out "$out/$name-cuda.json"
}

gpus=$(nvidia-smi --list-gpus | wc -l)
peers=$PWD/build/peers

# Comparisons of pictures, gradients, memory and scores, which may share a GPU.
untimed() {
  compare static static --full --steps 3000 &
  local beside=$!
  compare calls calls
  compare cameras cameras
  compare thresholds thresholds
  compare memory memory --full
  compare strategies strategies --full --steps 3000
  wait "$beside"
}

own_tests() {
  compare own_tests own_tests --tests "$sources/tests" --oracle "$peers/gsplat" --together 5 --timeout 400
}

timed() {
  local module script
  PYTHONPATH=$peers:$PYTHONPATH run suite "$python" benchmarks/suite.py --device cuda --only rasterization --out "$out"
  for script in "$@"; do
    for module in gsplat gsplat_core; do
      PYTHONPATH=$peers:$PYTHONPATH run "$(basename "$script" .py)-$module" "$python" "$script" --module "$module"
    done
  done
  PYTHONPATH=$peers:$PYTHONPATH compare surfels surfels --full --gsplat
  if [ -n "$examples" ]; then
    PYTHONPATH=$peers:$PYTHONPATH compare trainer trainer "$examples" --full --steps 3000 --seeds 0 1 2
    PYTHONPATH=$peers:$PYTHONPATH compare trainer_wide trainer "$examples" --full --wide --steps 1000 --seeds 0 --variants gsplat ours
  fi
}

run build benchmarks/gpu_build.sh || exit
run build_gsplat "$python" benchmarks/peers/build_gsplat.py "$wheel" "$peers" &
building=$!
if [ "$gpus" -gt 1 ]; then
  compare processes processes
fi
CUDA_VISIBLE_DEVICES=$((gpus > 1 ? 1 : 0)) untimed &
beside=$!
run tests benchmarks/gpu_tests.sh
wait "$building"

if [ "$gpus" -gt 1 ]; then
  CUDA_VISIBLE_DEVICES=1 own_tests &
  CUDA_VISIBLE_DEVICES=0 timed "$@"
  wait
else
  wait "$beside"
  timed "$@"
  own_tests
fi
