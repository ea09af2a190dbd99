#!/usr/bin/env bash
# scripts/setup.sh VENV EXTRA [PYTHON]: the package with its pinned dependencies in VENV; EXTRA is none, or an extra.
# Does nothing where VENV holds what pyproject.toml and constraints.txt ask for already. The other scripts call it.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

venv=$1 extra=$2 python=${3:-}

# has PYTHON MODULES: it runs, is new enough and can import these.
has() { "$1" -c "import sys, $2; sys.exit(sys.version_info < (3, 11))" > /dev/null 2>&1; }

# A venv whose Python is gone or too old is made again.
if ! has "$venv/bin/python" pip; then
    if [[ -z $python ]]; then
        for candidate in python3 python3.11 python3.12 python3.13; do
            if has "$candidate" "venv, ensurepip"; then python=$candidate && break; fi
        done
    fi
    if [[ -z $python ]] || ! has "$python" "venv, ensurepip"; then
        found=$(python3 --version 2> /dev/null || echo "no python3")
        echo "setup: found ${python:-$found}, expected Python 3.11 or newer with venv and pip (on Debian: apt install python3-venv)" >&2
        exit 1
    fi
    "$python" -m venv --clear "$venv"
fi

stamp=$venv/.stamp-$extra
wanted=$(sha256sum pyproject.toml constraints.txt; pwd; "$venv/bin/python" --version)
if [[ -f $stamp && $(< "$stamp") == "$wanted" ]]; then exit 0; fi

echo "setup: installing into $venv; this takes a minute or two" >&2
rm -f "$venv"/.stamp-*
target=.
if [[ $extra != none ]]; then target=".[$extra]"; fi
pip=("$venv/bin/python" -m pip --disable-pip-version-check --quiet install --constraint constraints.txt)
"${pip[@]}" --upgrade pip hatchling
# The pinned hatchling builds it, so that the build is reproducible too.
"${pip[@]}" --no-build-isolation --editable "$target"
if [[ $extra != none ]]; then echo "$wanted" > "$venv/.stamp-none"; fi
echo "$wanted" > "$stamp"
