#!/usr/bin/env bash
# A box with several GPUs: one worker per GPU. Usage: GPUS=8 bash box.sh scenes.txt runs/ --teacher lseg --weights demo_e200.ckpt
set -euo pipefail
gpus=${GPUS:-8} threads=${THREADS:-4} port=${PORT:-8786}
scenes=$1 out=$2
shift 2

dask scheduler --host 127.0.0.1 --port "$port" --no-dashboard &
started=($!)
trap 'kill "${started[@]}" 2>/dev/null || true' EXIT
for ((i = 0; i < gpus; i++)); do
  # The nanny of each worker starts it again when it dies. Memory has no limit but the machine's.
  CUDA_VISIBLE_DEVICES=$i dask worker "tcp://127.0.0.1:$port" --name "gpu$i" --nthreads 1 --memory-limit 0 --no-dashboard &
  started+=($!)
done
kfgs batch "$scenes" --out "$out" --scheduler "tcp://127.0.0.1:$port" --threads "$threads" "$@"
