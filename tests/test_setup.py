"""The set-up itself: enforced annotations, pins within their ranges, the small config, the line of a failed set-up."""

import subprocess
import tomllib

import jax.numpy as jnp
import jaxtyping
import pytest
from conftest import ROOT
from packaging.requirements import Requirement
from ruamel.yaml import YAML

from sbrdf_jax.harmonics import harmonic_orders


def test_annotations_of_the_package_are_enforced():
    with pytest.raises(jaxtyping.TypeCheckError):
        harmonic_orders("4")  # pyright: ignore[reportArgumentType]


def test_jax_is_strict_and_float64():
    assert jnp.ones(3).dtype == jnp.float64
    with pytest.raises(ValueError, match="rank_promotion"):
        _ = jnp.ones(3) + jnp.ones((2, 3))
    with pytest.raises(ValueError, match="dtype_promotion"):
        _ = jnp.ones(3) + jnp.ones(3, dtype=int)


@pytest.mark.parametrize("python", ["3.11", "3.12", "3.13"])
def test_each_python_has_one_pin_per_dependency_within_its_range(python):
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = [Requirement(line) for line in lines if not line.startswith("#")]
    here = [pin for pin in pins if pin.marker is None or pin.marker.evaluate({"python_version": python})]
    version = {pin.name: str(pin.specifier).removeprefix("==") for pin in here}
    assert len(version) == len(here), "a package with two pins"

    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    wanted = [*project["build-system"]["requires"], *project["project"]["dependencies"]]
    wanted += [text for texts in project["project"]["optional-dependencies"].values() for text in texts]
    for requirement in map(Requirement, wanted):
        if requirement.name != "sbrdf-jax":
            pin = version[requirement.name.replace(".", "-").lower()]
            assert requirement.specifier.contains(pin), f"{requirement.name}: pin {pin}, range {requirement.specifier}"


def test_the_quickstart_config_sets_two_keys_only():
    with (ROOT / "configs" / "quickstart.yaml").open() as file:
        config = YAML(typ="safe").load(file)
    assert config == {"input": {"path": "builtin:amber_glass"}, "output": {"path": "results/quickstart.h5"}}


def test_a_machine_without_a_new_enough_python_gets_one_line(tmp_path):
    programs = tmp_path / "bin"
    programs.mkdir()
    for name in ("python3", "python3.11", "python3.12", "python3.13"):
        (programs / name).write_text('#!/bin/sh\n[ "$1" = --version ] && echo Python 3.9.2\nexit $(( $# - 1 ))\n')
        (programs / name).chmod(0o755)
    setup = subprocess.run(
        [ROOT / "scripts" / "setup.sh", tmp_path / "venv", "none"],
        env={"PATH": f"{programs}:/usr/bin:/bin"},
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert (setup.returncode, setup.stdout) == (1, "")
    assert setup.stderr == (
        "setup: found Python 3.9.2, expected Python 3.11 or newer with venv and pip "
        "(on Debian: apt install python3-venv)\n"
    )
    assert not (tmp_path / "venv").exists()
