#!/bin/bash
# Measure the service on an NVIDIA GPU: ages at a client, load, killed processes, swapped models, overhead compared with `live`, layers.
#
#     RECORDINGS=FOLDER OUT=FOLDER [PARTS="ages crowd"] bash benchmarks/gpu_service.sh
#
# Run in the repository's root with both libraries built. RECORDINGS contains `cutting`, PY is the interpreter, PARTS the parts to run (default all). Each part
# has a time limit and a file in OUT, and does not stop the others. The limits add up to 19 minutes.
export PYTHONPATH=$PWD:$PYTHONPATH PYTHONUNBUFFERED=1 OMP_WAIT_POLICY=PASSIVE
R=${RECORDINGS:-${INTRASPLAT_RECORDINGS:-shared/recordings}}; PY=${PY:-python3}; OUT=${OUT:-/tmp/service}; mkdir -p "$OUT"
part() { # part NAME SECONDS COMMAND...
  local name=$1 most=$2 began=$SECONDS; shift 2
  [ -z "$PARTS" ] || [[ " $PARTS " = *" $name "* ]] || return 0
  timeout -k 5 "$most" "$@" >"$OUT/$name.json" 2>"$OUT/$name.err"; local rc=$?
  echo "== $name rc=$rc $((SECONDS - began)) s"; [ $rc = 0 ] && tr -d '\n' <"$OUT/$name.json" | tr -s ' ' && echo || tail -25 "$OUT/$name.err"
}
CUT="realtime:$R/cutting?loop=1&fps=30"
# 1. (Three phases of --seconds each.) Ages of encoded pictures at one client (required: p50 <= 30, p99 <= 43 ms); then 50 viewers, 10 of them slow, and 200 requests/s.
part ages 140 $PY benchmarks/service_load.py --device cuda --source "$CUT" --kind shown --viewers 1 --slow 0 --requests 0 --seconds 20 --settle 5
part crowd 120 $PY benchmarks/service_load.py --device cuda --source "$CUT" --kind both --viewers 50 --slow 10 --requests 200 --seconds 15
# 2. Engine killed 20 times (required: back within 5 s, no raw gap over 100 ms), capture 5 times (3 s), control plane 3 times.
part engine 170 $PY benchmarks/service_kills.py engine --device cuda --source "$CUT" --kills 20 --every 0.1 3
part capture 60 $PY benchmarks/service_kills.py capture --device cuda --source "$CUT" --kills 5 --every 0.1 3
part control 60 $PY benchmarks/service_kills.py control --device cuda --source "$CUT" --kills 3 --every 0.1 3
# 3. 100 activations and rollbacks (required: no frame without a model, no mixed frame, a swap within one frame).
part swaps 100 $PY benchmarks/service_swaps.py --device cuda --source "$CUT" --swaps 100 --gaussians 45000 --width 640 --height 512
# 4. (Twice each.) Overhead compared with `live` (required: at most 10 % more CPU per frame, 5 ms more latency at p50), and the cost of each hop.
part overhead 200 $PY benchmarks/service_overhead.py --device cuda --source "$CUT" --seconds 15
part cost 60 $PY benchmarks/service_cost.py
part cost1080 60 $PY benchmarks/service_cost.py --width 1920 --height 1080 --fps 60
# 5. Cost of depth, confidence, the virtual view and snapshots for a stream.
part layers 160 $PY benchmarks/service_layers.py --device cuda --source "$CUT" --seconds 12
