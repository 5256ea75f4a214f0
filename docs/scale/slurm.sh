#!/usr/bin/env bash
# The driver of a batch as a small job; it submits the workers as jobs of their own, one GPU each (see jobqueue.yaml).
# Usage: sbatch slurm.sh scenes.txt /shared/runs PARTITION WORKERS --teacher lseg --weights /shared/demo_e200.ckpt
# Without GPUs, end it with: --threads 2 --memory 8GB (the last ones count), and see jobqueue.yaml.
# If the driver's time is over, submit it again: it goes on.
#SBATCH --job-name=kfgs-batch
#SBATCH --cpus-per-task=1
#SBATCH --mem=4G
#SBATCH --time=2-00:00:00
#SBATCH --output=kfgs-batch-%j.log
set -euo pipefail
scenes=$1 out=$2 partition=$3 workers=$4
shift 4

source /shared/venv/bin/activate # a virtual environment with kfgs[scale] that all nodes can read
for name in $(compgen -e | grep '^SLURM_'); do unset "$name"; done # or the workers' jobs inherit this one's limits
kfgs batch "$scenes" --out "$out" --slurm "$partition" --workers "$workers" --threads 4 --memory 32GB "$@"
