#!/usr/bin/env bash
# Everything to know about a lent GPU, in at most 8 minutes (gpu.py explains the parts):
#
#     bash benchmarks/gpu.sh OUT [--scene TOY]
#     TRITON_INTERPRET=1 bash benchmarks/gpu.sh OUT --toy     # tries the script itself, without a GPU
#
# A part that takes too long is stopped; OUT/gpu.json and the table OUT/gpu.md keep what was finished.
set -uo pipefail
export PYTHONPATH="$(dirname "$0")/..${PYTHONPATH:+:$PYTHONPATH}"
out=${1:?the folder for the results}
shift
status=0
run() {
  timeout "$1" python -W ignore::RuntimeWarning "$(dirname "$0")/gpu.py" --out "$out" --parts "$2" "${@:3}" || { echo "$2: not finished"; status=1; }
}
run 180 kernels "$@"
run 120 speed "$@"
run 175 job --methods uplift "$@"
cat "$out/gpu.md"
exit $status
