#!/usr/bin/env bash
# Trains one run on a SLURM cluster, and goes on by itself when the job was preempted or ran out of
# time:
#
#     RUN=/shared/runs/humanoid sbatch experiments/cluster/slurm.sh --env Humanoid --seeds 8
#
# RUN is a folder that all nodes see; what follows the script's name are flags of `sacformer train`.
# One process for each GPU; they find each other through SLURM. SIGTERM, sent to them three minutes
# before the end (and by SLURM when it preempts the job), makes them finish their chunk, save and
# exit with code 3, upon which the job puts itself back into the queue.
#SBATCH --job-name=sacformer
#SBATCH --nodes=1
#SBATCH --ntasks-per-node=8
#SBATCH --gpus-per-task=1
#SBATCH --cpus-per-task=8
#SBATCH --time=24:00:00
#SBATCH --signal=TERM@180
#SBATCH --requeue
#SBATCH --open-mode=append
set -uo pipefail

: "${RUN:?set RUN to a folder that all nodes see}"
SACFORMER=${SACFORMER:-sacformer}
STOPPED_AFTER_SAVING=3

# How a run lies on devices is no part of it, so resuming is told again.
devices=() before=""
for flag in "$@"; do
    case $flag in
        --seed[-_]devices=* | --data[-_]devices=*) devices+=("$flag") ;;
    esac
    case $before in
        --seed[-_]devices | --data[-_]devices) devices+=("$before" "$flag") ;;
    esac
    before=$flag
done
if [[ -f $RUN/config.json ]]; then
    command=(resume "$RUN" "${devices[@]}")
else
    command=(train --run-dir "$RUN" "$@")
fi
echo "$(date --iso-8601=seconds) job ${SLURM_JOB_ID:?}, start ${SLURM_RESTART_COUNT:-0}: ${command[*]}"
srun "$SACFORMER" "${command[@]}" --distributed
code=$?
if [[ $code -eq $STOPPED_AFTER_SAVING ]]; then
    scontrol requeue "$SLURM_JOB_ID"
fi
exit $code
