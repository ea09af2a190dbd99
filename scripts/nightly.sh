#!/usr/bin/env bash
# Runs every test, the slow ones too: scripts/nightly.sh [pytest arguments ...]
set -euo pipefail

exec "$(dirname "${BASH_SOURCE[0]}")/test.sh" -m "slow or not slow" "$@"
