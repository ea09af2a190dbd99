#!/usr/bin/env bash
# Runs every test, the slow ones too, on code compiled as users run it: scripts/nightly.sh [pytest arguments ...]
set -euo pipefail
export XLA_FLAGS=${XLA_FLAGS:-}

exec "$(dirname "${BASH_SOURCE[0]}")/test.sh" -m "slow or not slow" "$@"
