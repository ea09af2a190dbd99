#!/usr/bin/env bash
# Runs every test, the slow ones too, on code compiled as users run it, and 100,000 damaged files a reader:
# scripts/nightly.sh [pytest arguments ...]
set -euo pipefail
export XLA_FLAGS=${XLA_FLAGS:-}

exec "$(dirname "${BASH_SOURCE[0]}")/test.sh" -m "slow or not slow" --fuzz-inputs 100000 "$@"
