#!/usr/bin/env bash
# Installs the test extra into .venv, then runs the tests, two files at a time: scripts/test.sh [pytest arguments ...]
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

scripts/setup.sh .venv test
# A file stays on one worker, so that what it compiled is used again. More workers would only compete for the cores.
exec .venv/bin/python -m pytest -n 2 --dist loadfile "$@"
