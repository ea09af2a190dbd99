#!/bin/sh
# One library as a job array of Slurm: each task brings its part of the materials to their results, and what is done is
# skipped, so that the same script may be submitted again at any time. `sbrdf batch LIBRARY.yaml --executor slurm` fills in
# what stands in braces, writes it to OUTPUT_FOLDER/slurm_array.sh and submits it; by hand: sbatch OUTPUT_FOLDER/slurm_array.sh
#SBATCH --job-name=sbrdf
#SBATCH --array={tasks}
#SBATCH --cpus-per-task={cores}
#SBATCH --chdir={directory}
#SBATCH --output={output}
#SBATCH --open-mode=append
{options}
set -e
{set_up}
exec {command} --shard "$SLURM_ARRAY_TASK_ID/{shards}"
