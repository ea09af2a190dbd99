"""`represent.method: auto`: the better of two forms for every kind of target, and why the second was not tried."""

import dataclasses

import numpy as np
import pytest

from sbrdf_jax import builtin
from sbrdf_jax.encoding import data_basis, encode_field
from sbrdf_jax.metrics import stored_numbers
from sbrdf_jax.options import ErrorBudget, RepresentOptions, TargetOptions
from sbrdf_jax.records import GriddedBRDF, LobeHarmonics, LobeTensor
from sbrdf_jax.representation import represent, represent_with_plan
from sbrdf_jax.representation.lobe_harmonics import least_numbers

THETA = np.radians(np.arange(0, 90.1, 15))
PHI = np.radians(np.arange(0, 360.1, 15))
WAVELENGTH_NM = np.linspace(400.0, 700.0, 9)


def options(method="auto", **target) -> RepresentOptions:
    return RepresentOptions(method=method, target=TargetOptions(**target))


@pytest.fixture(scope="module")
def amber():
    brdf = np.asarray(builtin.true_brdf("amber_glass", *np.meshgrid(THETA, THETA, PHI, indexing="ij"), WAVELENGTH_NM))
    lanes = np.zeros(len(WAVELENGTH_NM))
    gridded = GriddedBRDF(THETA, THETA, PHI, WAVELENGTH_NM, brdf, np.zeros(brdf.shape[:3], int), lanes, lanes, lanes)
    return gridded, encode_field(gridded, data_basis(WAVELENGTH_NM, brdf, 4))


@pytest.mark.parametrize("target", [{"error": 0.1}, {"delta_e": 5.0}, {"numbers": 22}], ids=str)
def test_the_better_of_both_is_taken_and_the_plan_says_what_each_reached(amber, target):
    gridded, field = amber
    found, plan = represent_with_plan(field, options(**target), gridded)
    both = {name: represent_with_plan(field, options(name, **target), gridded) for name in plan["tried"]}
    assert list(both) == ["lobe_tensor", "lobe_harmonics"]
    met = {name: stored_numbers(form) for name, (form, own) in both.items() if own["is_met"]}
    assert plan["is_met"] and plan["method"] == min(met, key=lambda name: met[name])
    assert stored_numbers(found) == met[plan["method"]]
    for name, (form, _) in both.items():
        assert plan["tried"][name].startswith(f"{stored_numbers(form) / len(THETA):.4g} numbers")
    assert least_numbers(both["lobe_tensor"][0]) <= stored_numbers(both["lobe_harmonics"][0])


@pytest.mark.parametrize(
    ("target", "reason"),
    [
        ({"numbers": 120}, "hardly ever below 2 %"),
        ({"ratio": 40.0}, "hardly ever below 2 %"),
        ({"error": 0.01}, "hardly ever below 2 %"),
        ({"numbers": 5}, "it takes 15 numbers"),
    ],
    ids=str,
)
def test_lobe_harmonics_is_not_tried_where_it_cannot_be_better(amber, target, reason, monkeypatch):
    gridded, field = amber
    monkeypatch.setattr("sbrdf_jax.representation.lobe_harmonics.represent", None)
    found, plan = represent_with_plan(field, options(**target), gridded)
    same = represent(field, options("lobe_tensor", **target), gridded)
    assert reason in plan["tried"]["lobe_harmonics"] and plan["method"] == "lobe_tensor"
    assert isinstance(found, LobeTensor)
    np.testing.assert_array_equal(found.core, same.core)


def test_of_a_scene_and_a_budget_the_lobe_tensor_is_taken(amber):
    gridded, field = amber
    needed = np.ones(gridded.brdf.shape[:3], bool)
    needed[:, -1] = False
    part = dataclasses.replace(gridded, needed=needed)
    assert "whole hemispheres" in represent_with_plan(field, options(error=0.1), part)[1]["tried"]["lobe_harmonics"]
    _, plan = represent_with_plan(field, options(numbers=60), gridded, budget=ErrorBudget(error=0.1))
    assert plan["method"] == "lobe_tensor" and "budget of error" in plan["tried"]["lobe_harmonics"]


def test_where_neither_meets_the_target_the_lesser_error_is_taken(amber):
    gridded, field = amber
    found, plan = represent_with_plan(field, options(error=1e-9), gridded)
    other = represent_with_plan(field, options("lobe_harmonics", error=1e-9), gridded)[1]
    assert not plan["is_met"] and "is not met" in plan["warnings"][0]
    assert plan["worst"] <= other["worst"] and not isinstance(found, LobeHarmonics)
