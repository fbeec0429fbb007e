#!/bin/sh
# Ant and Go2 at 4,096 and 16,384 simulations on one GPU by the package's own solver and
# by mjx.step, their searches, and MuJoCo Warp where warp-lang is installed; 10 minutes
# at most. Lines go to benchmarks/results/engines.jsonl; what has one is not done again.
#   sh scripts/engines_on_gpu.sh [OUT.jsonl]
python=${PYTHON:-python3}
out=${1:-benchmarks/results/engines.jsonl}
timeout 200 "$python" -m benchmarks.engines --robots go2 ant --at-once 8 \
  --programs mjx mjx.step --kinds replay --populations 4096 16384 \
  --repeats 3 --out "$out"
timeout 260 "$python" -m benchmarks.engines --robots go2 ant --programs mjx \
  --kinds search --out "$out"
"$python" -c 'import warp' 2>/dev/null || { echo "no warp-lang: skipped"; exit 0; }
timeout 130 "$python" -m benchmarks.engines --robots go2 ant --programs warp \
  --kinds replay --populations 4096 16384 --repeats 3 --out "$out"
