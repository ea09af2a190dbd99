"""The embedded sample: its formula against a plain twin, its published numbers, its directions and its noise."""

import math

import numpy as np
import pytest

from sbrdf_jax import builtin
from sbrdf_jax.cli import main
from sbrdf_jax.errors import UserError
from sbrdf_jax.formats import read
from sbrdf_jax.options import InputOptions

NAMES = sorted(builtin.MATERIALS)
PARAMETERS = {"amber_glass": (0.20, 0.93), "amber_glass_sharp": (0.12, 0.0), "amber_glass_broad": (0.35, 0.0)}


def plain_amber(name, theta_i, theta_o, phi_o, wavelength):
    """The formula as printed, one value at a time, by vectors."""
    alpha, r = PARAMETERS[name]
    floor = math.cos(math.radians(85))

    def vector(theta, phi):
        return np.array([math.sin(theta) * math.cos(phi), math.sin(theta) * math.sin(phi), math.cos(theta)])

    def reflectance(theta, index=1.52):
        refracted = math.asin(math.sin(theta) / index)
        if theta < 1e-6:
            return ((index - 1) / (index + 1)) ** 2
        s = math.sin(theta - refracted) / math.sin(theta + refracted)
        p = math.tan(theta - refracted) / math.tan(theta + refracted)
        return (s * s + p * p) / 2

    def smith(c):
        return (math.sqrt(1 + alpha**2 * (1 - c * c) / (c * c)) - 1) / 2

    w_i, w_o = vector(theta_i, 0.0), vector(theta_o, phi_o)
    half = (w_i + w_o) / np.linalg.norm(w_i + w_o)
    theta_h = math.acos(min(half[2], 1.0))
    theta_d = math.acos(min(float(half @ w_i), 1.0))
    beta = math.acos(np.clip(float(w_o @ vector(theta_i, math.pi)), -1, 1))
    cos_i, cos_o = max(w_i[2], floor), max(w_o[2], floor)
    d = alpha**2 / (math.pi * math.cos(theta_h) ** 4 * (alpha**2 + math.tan(theta_h) ** 2) ** 2)
    g = 1 / (1 + smith(cos_i) + smith(cos_o))
    s = 0.02 + 0.28 / (1 + math.exp(-(wavelength - 552) / 17)) * (1 - r / (1 + math.exp(-(wavelength - 715) / 16)))
    transmitted = (1 - reflectance(math.acos(cos_i))) * (1 - reflectance(math.acos(cos_o)))
    haze = 1 + 0.35 * math.exp(-((beta / math.radians(42)) ** 2))
    return d * g * reflectance(theta_d) / (4 * cos_i * cos_o) + transmitted * s / math.pi * haze


@pytest.mark.parametrize("name", NAMES)
def test_truth_equals_the_printed_formula(name, rng):
    theta_i, theta_o = rng.uniform(0, np.pi / 2, (2, 60))
    phi_o = rng.uniform(0, 2 * np.pi, 60)
    wavelength = rng.uniform(380, 780, 60)
    found = builtin.true_brdf(name, theta_i, theta_o, phi_o, wavelength)[np.arange(60), np.arange(60)]
    expected = [plain_amber(name, *args) for args in zip(theta_i, theta_o, phi_o, wavelength, strict=True)]
    np.testing.assert_allclose(found, expected, rtol=1e-9)  # arccos near 0 limits the twin


def test_truth_broadcasts_and_is_reciprocal_and_bilateral():
    angle = np.radians(np.linspace(0, 90, 7))
    phi = np.radians(np.linspace(0, 360, 9))
    field = builtin.true_brdf("amber_glass", angle[:, None, None], angle[:, None], phi, builtin.WAVELENGTH_NM)
    assert field.shape == (7, 7, 9, 101)
    assert np.isfinite(field).all() and field.min() > 0
    np.testing.assert_allclose(field, field.swapaxes(0, 1), rtol=1e-12)
    np.testing.assert_allclose(field, field[:, :, ::-1], rtol=1e-12)
    np.testing.assert_allclose(np.ptp(field[:, 0], axis=1), 0, atol=1e-14)  # one value at the pole
    assert builtin.true_brdf("builtin:amber_glass", 0.1, 0.2, 0.3, 550).shape == (1,)


@pytest.mark.parametrize(
    ("name", "ends", "truncation"),
    [
        ("amber_glass", (0.09, 0.11), (0.8, 1.0)),
        ("amber_glass_sharp", (0.70, 1.01), (6.3, 9.1)),
        ("amber_glass_broad", (1.08, 1.09), (9.7, 9.8)),
    ],
)
def test_spectra_have_the_stated_ends_and_truncation_error(name, ends, truncation):
    theta_o = np.radians(np.arange(13) * 7.5)[:, None]
    phi_o = np.radians(np.arange(49) * 7.5)
    for theta_i, end, error in zip((0.0, np.pi / 6), ends, truncation, strict=True):
        field = builtin.true_brdf(name, theta_i, theta_o, phi_o, builtin.WAVELENGTH_NM).reshape(-1, 101)
        jump = np.linalg.norm(field[:, -1] - field[:, 0]) / np.linalg.norm(field) * np.sqrt(101)
        assert jump == pytest.approx(end, abs=0.006)
        merged = field[:, :-1].copy()
        merged[:, 0] = (field[:, 0] + field[:, -1]) / 2
        coefficient = np.fft.rfft(merged)
        coefficient[:, 10:] = 0  # 19 real numbers are left
        series = np.fft.irfft(coefficient, 100)
        left = np.hstack([series, series[:, :1]]) - field
        assert 100 * np.linalg.norm(left) / np.linalg.norm(field) == pytest.approx(error, abs=0.06)


@pytest.mark.parametrize("count", [None, 60, 1500])
def test_directions_follow_the_measurement_plan(count):
    measured = builtin.measure("amber_glass", count=count)
    wanted = 770 if count is None else count
    theta_i, counts = np.unique(measured.theta_i, return_counts=True)
    np.testing.assert_allclose(np.degrees(theta_i), builtin.THETA_I_DEG)
    assert (np.abs(counts - wanted) <= 0.1 * wanted).all()
    assert np.degrees(measured.theta_o.max()) <= 85 and measured.theta_o.min() >= 0
    assert measured.phi_o.min() >= 0 and measured.phi_o.max() < 2 * np.pi

    def unit(theta, phi):
        return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)

    w_o = unit(measured.theta_o, measured.phi_o)
    retro = np.degrees(np.arccos(np.clip(np.sum(w_o * unit(measured.theta_i, 0 * measured.theta_i), -1), -1, 1)))
    assert retro.min() >= 4
    if count is None:
        from_mirror = np.degrees(np.arccos(np.clip(np.sum(w_o * unit(measured.theta_i, np.pi), -1), -1, 1)))
        at_45 = np.isclose(measured.theta_i, np.pi / 4)
        for near, low, high in ((from_mirror < 20, 1.0, 3.5), ((from_mirror > 35) & (measured.theta_o > 1), 2.0, 9.0)):
            w = w_o[at_45 & near]
            distance = np.degrees(np.arccos(np.clip(w @ w.T - 2 * np.eye(len(w)), -1, 1)))
            assert low < np.median(distance.min(axis=1)) < high
        folded, _ = np.histogram(np.degrees(measured.phi_o), bins=np.arange(0, 361, 15))
        assert folded.min() > 0


def test_measurement_is_deterministic_and_noise_scales():
    first, again = builtin.measure("amber_glass", count=50), builtin.measure("builtin:amber_glass", count=50)
    assert np.array_equal(first.value, again.value) and first.source_sha256 == again.source_sha256
    other_seed = builtin.measure("amber_glass", seed=1, count=50)
    assert not np.array_equal(first.theta_o[:40], other_seed.theta_o[:40])
    assert np.array_equal(first.theta_o, builtin.measure("amber_glass_broad", count=50).theta_o)
    exact = builtin.measure("amber_glass", count=50, noise=0)
    truth = builtin.true_brdf("amber_glass", exact.theta_i, exact.theta_o, exact.phi_o, exact.wavelength_nm)
    assert np.array_equal(exact.value, truth) and np.array_equal(exact.theta_o, first.theta_o)
    twice = builtin.measure("amber_glass", count=50, noise=2.0)
    np.testing.assert_allclose(twice.value - truth, 2 * (first.value - truth), rtol=1e-6, atol=1e-15)


def test_noise_has_the_stated_size():
    measured = builtin.measure("amber_glass", seed=4)
    truth = builtin.true_brdf("amber_glass", measured.theta_i, measured.theta_o, measured.phi_o, measured.wavelength_nm)
    offset = 2e-4 / np.maximum(np.cos(measured.theta_i), np.cos(np.radians(85)))[:, None]
    scaled = (measured.value - truth) / np.sqrt(2 * (0.010 * truth) ** 2 + offset**2)
    assert np.std(scaled) == pytest.approx(1, abs=0.02)
    bright = truth.min(axis=1) > 0.5
    shared = np.mean(((measured.value - truth) / truth)[bright], axis=1)  # u is what a sample's wavelengths share
    assert np.std(shared) == pytest.approx(0.010, rel=0.15)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ({"name": "amber"}, "no such embedded material"),
        ({"seed": -1}, "seed: found -1"),
        ({"count": 3}, "count: found 3"),
        ({"count": 10**9}, "count: found 1000000000"),
        ({"noise": -0.5}, "noise: found -0.5"),
        ({"noise": math.nan}, "noise: found nan"),
    ],
)
def test_wrong_arguments_are_one_line(arguments, expected):
    with pytest.raises(UserError, match=expected):
        builtin.measure(**({"name": "amber_glass"} | arguments))


@pytest.mark.parametrize("ending", ["csv", "h5"])
def test_sample_command_writes_a_file_that_reads_back(tmp_path, capsys, ending):
    output = tmp_path / "new" / f"amber.{ending}"
    arguments = [
        "sample",
        "amber_glass_sharp",
        "--output",
        str(output),
        "--seed",
        "3",
        "--count",
        "20",
        "--noise",
        "0.5",
    ]
    assert main(arguments) == 0
    assert "260 samples x 101 wavelengths" in capsys.readouterr().out
    found = read(output, InputOptions(path=str(output)))
    expected = builtin.measure("amber_glass_sharp", seed=3, count=20, noise=0.5)
    assert np.array_equal(found.value, expected.value)
    np.testing.assert_allclose(found.theta_o, expected.theta_o, rtol=0, atol=1e-14)
    assert [path.name for path in output.parent.iterdir()] == [output.name]


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["amber", "--output", "a.csv"], "no such embedded material"),
        (["amber_glass", "--output", "a.txt"], "ending"),
        (["amber_glass", "--output", "a.csv", "--count", "2"], "count"),
    ],
)
def test_sample_command_refuses(tmp_path, monkeypatch, capsys, arguments, expected):
    monkeypatch.chdir(tmp_path)
    assert main(["sample", *arguments]) == 2
    assert expected in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
