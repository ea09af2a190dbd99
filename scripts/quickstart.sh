#!/usr/bin/env bash
# Installs into .venv, then runs configs/quickstart.yaml: measurement in, results/quickstart.h5 and a report out.
# scripts/quickstart.sh [key.path=value ...]
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

scripts/setup.sh .venv none
exec .venv/bin/python -m sbrdf_jax.run configs/quickstart.yaml output.overwrite=true "$@"
