#!/bin/sh
# Whether a seed gives the same result twice on a GPU, as it is and with XLA's operations
# of random order left out; 10 minutes at most. Results go to benchmarks/results.
#   sh scripts/same_twice_on_gpu.sh [FOLDER]
python=${PYTHON:-python3}
out=${1:-benchmarks/results}
status=0
timeout 240 "$python" -m benchmarks.same_twice --robot cartpole --folder "$out" || status=1
timeout 340 "$python" -m benchmarks.same_twice --robot ant --env-steps 200000 \
  --folder "$out" || status=1
exit $status
