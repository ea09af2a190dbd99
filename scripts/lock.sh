#!/usr/bin/env bash
# Resolves pyproject.toml with all its extras on Python 3.11, 3.12 and 3.13, and writes constraints.txt: one pin for
# each package, or one per Python, by marker, where they differ. Then checks that every pin has a wheel for
# x86-64 and Arm Linux. Needs the three Pythons: as python3.11 ... on PATH, or by PYTHON311=/path/to/python ...
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

for version in 3.11 3.12 3.13; do
    override="PYTHON${version/./}"
    "${!override:-python$version}" -m venv "$work/$version"
    "$work/$version/bin/python" -m pip install --quiet --upgrade pip
    "$work/$version/bin/python" -m pip install --quiet --dry-run --ignore-installed --only-binary :all: \
        --report "$work/$version.json" ".[dev,render,cluster,bench]" pip hatchling
done

"$work/3.11/bin/python" - "$work" > "$work/constraints.txt" <<'PYTHON'
import json, re, sys
from pathlib import Path

VERSIONS = ["3.11", "3.12", "3.13"]
pins: dict[str, dict[str, list[str]]] = {}  # package -> its version -> the Pythons that resolve to it
for python in VERSIONS:
    for item in json.loads(Path(sys.argv[1], f"{python}.json").read_text())["install"]:
        name = re.sub(r"[-_.]+", "-", item["metadata"]["name"]).lower()
        if name != "sbrdf-jax":
            pins.setdefault(name, {}).setdefault(item["metadata"]["version"], []).append(python)

MARKERS = {
    "3.11": "python_version < '3.12'",
    "3.12": "python_version == '3.12'",
    "3.13": "python_version >= '3.13'",
    "3.11 3.12": "python_version < '3.13'",
    "3.12 3.13": "python_version >= '3.12'",
}
print("# Written by scripts/lock.sh: every package that the scripts install, for Python 3.11 to 3.13 on Linux.")
for name in sorted(pins):
    for version, pythons in sorted(pins[name].items(), key=lambda pin: pin[1]):
        marker = "" if pythons == VERSIONS else f" ; {MARKERS[' '.join(pythons)]}"
        print(f"{name}=={version}{marker}")
PYTHON

for version in 3.11 3.12 3.13; do
    for machine in x86_64 aarch64; do
        platforms=(--platform "manylinux2014_$machine")
        for glibc in {17..28}; do platforms+=(--platform "manylinux_2_${glibc}_$machine"); done
        "$work/$version/bin/python" -m pip install --quiet --dry-run --no-deps --only-binary :all: --target "$work/none" \
            "${platforms[@]}" --requirement "$work/constraints.txt" ||
            { echo "lock: Python $version on $machine lacks a wheel (above); constraints.txt left as it was" >&2; exit 1; }
    done
done
mv "$work/constraints.txt" constraints.txt
echo "lock: constraints.txt has $(grep -c == constraints.txt) pins"
