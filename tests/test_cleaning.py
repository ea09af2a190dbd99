"""Cleaning: a planted defect of each kind, real files, drop-outs that are planted and not, coverage in words."""

import dataclasses
from typing import Literal

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sbrdf_jax import builtin, formats
from sbrdf_jax.cleaning import Flag, clean
from sbrdf_jax.cli import main
from sbrdf_jax.coverage import cluster_incidences, find_coverage
from sbrdf_jax.dropouts import find_dropouts, spectral_noise
from sbrdf_jax.errors import UserError
from sbrdf_jax.layout import read_cleaning, write_cleaning
from sbrdf_jax.options import InputOptions
from sbrdf_jax.records import RawSamples

CORNELL = ("garnet_red", "cayman", "acryl_blue")


@pytest.fixture(scope="module")
def amber():
    return builtin.measure("amber_glass", count=120)


def changed(samples, **rows):
    """A copy with some entries replaced: name -> (index, value)."""
    arrays = {name: getattr(samples, name).copy() for name in rows}
    for name, (index, value) in rows.items():
        arrays[name][index] = value
    return dataclasses.replace(samples, **arrays)


def cornell(shared, name):
    return formats.read(shared(f"data/cornell/{name}.brdf"), InputOptions(path=name))


def entry(report, name):
    return next(found for found in report.entries if found.name == name)


# Each kind of defect


def test_a_clean_measurement_loses_nothing(amber):
    quiet = builtin.measure("amber_glass", count=120, noise=0)
    result = clean(quiet)
    assert not result.report.flag.any() and result.report.flag.dtype == np.uint16
    assert result.report.num_kept == result.report.num_rows == quiet.num_samples
    np.testing.assert_array_equal(result.samples.value, quiet.value)
    assert [found.rows for found in result.report.entries] == [0] * 8


PLANTED = [
    ("value is nan", {"value": ((5, 3), np.nan)}, 5, Flag.NONFINITE, "dropped", 1),
    ("value is inf", {"value": ((5, 3), np.inf)}, 5, Flag.NONFINITE, "dropped", 1),
    ("value is huge", {"value": ((5, 3), -1e308)}, 5, Flag.NONFINITE, "dropped", 1),
    ("angle is nan", {"theta_o": (5, np.nan)}, 5, Flag.NONFINITE, "dropped", 0),
    ("azimuth is inf", {"phi_o": (5, -np.inf)}, 5, Flag.NONFINITE, "dropped", 0),
    ("below the horizon", {"theta_o": (5, np.radians(90.01))}, 5, Flag.BELOW_HORIZON, "dropped", 0),
    ("theta_o rounded", {"theta_o": (5, 1.5708)}, 5, Flag.CLIPPED, "clipped", 0),
    ("negative", {"value": ((5, slice(0, 3)), -1e-4)}, 5, Flag.NEGATIVE, "flagged", 3),
    ("exact zero", {"value": ((5, slice(0, 2)), 0.0)}, 5, Flag.ZERO, "flagged", 2),
]


@pytest.mark.parametrize(
    ("rows", "row", "flag", "action", "values"), [p[1:] for p in PLANTED], ids=[p[0] for p in PLANTED]
)
def test_each_defect_has_a_flag_a_count_and_a_reason(rows, row, flag, action, values):
    quiet = builtin.measure("amber_glass", count=120, noise=0)
    result = clean(changed(quiet, **rows))
    report = result.report
    expected = np.zeros(quiet.num_samples, np.uint16)
    expected[row] = flag
    np.testing.assert_array_equal(report.flag, expected)
    found = entry(report, flag.name.lower())
    assert (found.action, found.rows, found.values) == (action, 1, values)
    assert found.reason and found.examples[0].startswith(f"row {row}: theta_i")
    kept = quiet.num_samples - (action == "dropped")
    assert result.samples.num_samples == report.num_kept == kept
    assert (row in result.samples.row) == (action != "dropped")
    assert result.samples.theta_o.max() <= np.pi / 2
    assert any(found.name in line for line in report.lines())


def test_duplicates_are_flagged_and_kept_and_mirror_twins_are_none(amber):
    index = np.concatenate([np.arange(amber.num_samples), [7, 7, 30]])
    twice = dataclasses.replace(amber.take(index), row=np.arange(len(index)))
    twins = changed(twice, phi_o=(-1, 2 * np.pi - amber.phi_o[30]))
    report = clean(twins).report
    assert np.flatnonzero(report.flag & Flag.DUPLICATE).tolist() == [amber.num_samples, amber.num_samples + 1]
    assert report.num_kept == len(index)
    # at the pole every azimuth is one direction; at theta_i = 0 azimuths are not
    pole = changed(twice, theta_o=(slice(0, 2), 0.0), theta_i=(slice(0, 2), 0.3))
    assert clean(pole).report.flag[1] & Flag.DUPLICATE


def test_a_dead_channel_fails_alone(amber):
    dead = changed(amber, value=((slice(None), 4), np.nan))
    result = clean(dead)
    assert result.samples.num_samples == amber.num_samples
    np.testing.assert_array_equal(result.report.dead_wavelength_nm, amber.wavelength_nm[[4]])
    assert np.isnan(result.samples.value[:, 4]).all() and np.isfinite(np.delete(result.samples.value, 4, axis=1)).all()
    assert any("396 nm" in line for line in result.report.lines())
    mostly = dead.value.copy()
    mostly[::3, 4] = 1.0  # a third is there: dead all the same, and NaN throughout afterwards
    assert np.isnan(clean(dataclasses.replace(amber, value=mostly)).samples.value[:, 4]).all()


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        ({"theta_o": (slice(3, None), 2.0)}, "found 3 usable samples"),
        ({"value": (slice(None), -1.0)}, "no positive value"),
        ({"value": (slice(None), np.nan)}, "no positive value"),
        ({"value": (slice(None), 1e-310)}, "but below 1e-30"),
        ({"value": ((slice(None), 0), np.nan), "theta_i": (slice(None), np.nan)}, "found 0 usable samples"),
    ],
)
def test_nothing_usable_is_one_line(amber, rows, expected):
    with pytest.raises(UserError, match=expected):
        clean(changed(amber, **rows))


def test_folding_is_resolved_and_counted(amber, shared):
    both, one = amber, amber.take(amber.phi_o <= np.pi)
    settings_and_answers: list[tuple[RawSamples, str, bool | Literal["auto"], bool]] = [
        (both, "paper", "auto", False),
        (both, "guided", "auto", True),
        (both, "paper", True, True),
        (both, "guided", False, False),
        (one, "paper", "auto", True),
        (one, "paper", False, False),
    ]
    for samples, method, setting, expected in settings_and_answers:
        report = clean(samples, bilateral=setting, method=method).report
        assert report.bilateral is expected
        assert entry(report, "folded").rows == (np.sum(samples.phi_o > np.pi + 1e-4) if expected else 0)


def test_report_survives_storage(amber, tmp_path):
    planted = changed(amber, value=((3, 5), np.nan), theta_o=(9, 1.5708))
    report = clean(planted).report
    with h5py.File(tmp_path / "report.h5", "w") as file:
        write_cleaning(file, report)
        again = read_cleaning(file)
    assert again.entries == report.entries and again.lines() == report.lines()
    np.testing.assert_array_equal(again.flag, report.flag)
    assert again.flag.dtype == np.uint16 and again.bilateral is False
    np.testing.assert_allclose(again.coverage.theta_i, report.coverage.theta_i, rtol=1e-15)
    assert again.coverage.missing == report.coverage.missing


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), scale=st.sampled_from([1e-6, 1.0, 1e6]))
def test_order_and_scale_change_nothing(seed, scale):
    samples = builtin.measure("amber_glass", count=40)
    rng = np.random.default_rng(seed)
    value = samples.value.copy()
    value[rng.integers(0, samples.num_samples, 12)] *= 1e-4
    value[rng.integers(0, samples.num_samples, 5), 3] = np.nan
    planted = dataclasses.replace(samples, value=value)
    order = rng.permutation(samples.num_samples)
    shuffled = dataclasses.replace(planted.take(order), value=value[order] * scale)
    np.testing.assert_array_equal(clean(shuffled).report.flag, clean(planted).report.flag[order])


# Drop-outs


@pytest.mark.parametrize("name", CORNELL)
def test_cornell_dropouts_are_found_and_nothing_else(shared, name):
    samples = cornell(shared, name)
    report = clean(samples).report
    low = np.flatnonzero(report.flag & Flag.DROPOUT)
    degrees = np.degrees(np.stack([samples.theta_i, samples.theta_o, samples.phi_o - 2 * np.pi], axis=1)[low])
    np.testing.assert_allclose(degrees[:, :2], [[80, 79.05]] * len(low), atol=0.01)
    azimuths = sorted(np.round(degrees[:, 2]))
    # in garnet_red the sample at -155 is only half as bright as its neighbours
    assert azimuths == ([-170, -165, -160] if name == "garnet_red" else [-170, -165, -160, -155])
    zeros = {"garnet_red": 0.005, "cayman": 0.265, "acryl_blue": 0.424}[name]
    assert entry(report, "zero").values / samples.value.size == pytest.approx(zeros, abs=0.001)
    assert entry(report, "duplicate").rows == entry(report, "nonfinite").rows == 0


@pytest.mark.parametrize("name", sorted(builtin.MATERIALS))
@pytest.mark.parametrize("noise", [0.0, 1.0, 4.0])
def test_no_false_dropouts_on_the_embedded_samples(name, noise):
    assert not (clean(builtin.measure(name, noise=noise, count=300)).report.flag & Flag.DROPOUT).any()


def test_planted_dropouts_are_found(rng):
    samples = builtin.measure("amber_glass", count=300)
    truth = builtin.true_brdf("amber_glass", samples.theta_i, samples.theta_o, samples.phi_o, samples.wavelength_nm)
    offset = 2e-4 / np.maximum(np.cos(samples.theta_i), np.cos(np.radians(85)))
    bright = np.flatnonzero(truth.mean(axis=1) > 20 * offset)
    planted = rng.choice(bright, 40, replace=False)
    noise = samples.value[planted] - truth[planted]
    low = changed(samples, value=(planted, truth[planted] / 30 + noise / 30))
    found = find_dropouts(low, cluster_incidences(low.theta_i)[1])
    assert found[planted].mean() > 0.9
    assert found.sum() - found[planted].sum() <= 1
    one_wavelength = changed(samples, value=((planted, 50), 0.0))  # not in most wavelengths
    assert not find_dropouts(one_wavelength, cluster_incidences(low.theta_i)[1]).any()


def test_dropouts_in_one_plane_and_in_tiny_sets(amber):
    angle = np.radians(np.arange(-80, 81, 5.0))
    count = len(angle)
    plane = dataclasses.replace(
        amber.take(np.arange(count)),
        theta_i=np.full(count, 0.5),
        theta_o=np.abs(angle),
        phi_o=np.where(angle > 0, np.pi, 0.0),
        value=np.exp(-4 * (angle - 0.5) ** 2)[:, None] + np.full((count, 101), 0.1),
    )
    low = changed(plane, value=(10, 1e-3))
    incidence = np.zeros(count, int)
    assert not find_dropouts(plane, incidence).any()
    assert np.flatnonzero(find_dropouts(low, incidence)).tolist() == [10]
    end = changed(plane, value=(0, 1e-3))  # the end of a scan may be dark
    assert not find_dropouts(end, incidence).any()
    assert not find_dropouts(low.take(np.arange(8, 13)), np.zeros(5, int)).any()  # too few to judge


def test_noise_is_estimated_from_the_spectrum(rng):
    wavelength = np.linspace(0, 1, 60)
    spectra = 1 + np.sin(3 * wavelength) + rng.uniform(0, 1, (400, 1))
    noisy = spectra + 0.01 * rng.standard_normal(spectra.shape)
    assert spectral_noise(noisy) == pytest.approx(0.01, rel=0.1)
    assert spectral_noise(1e6 * noisy) == pytest.approx(1e6 * spectral_noise(noisy))
    assert spectral_noise(np.zeros((5, 4))) == 0
    assert spectral_noise(np.full((5, 2), 3.0)) == pytest.approx(0.3)  # too few wavelengths
    assert 0 < spectral_noise(np.full((5, 9), 3.0)) < 1e-4


# Coverage


def test_cornell_coverage_names_what_is_missing(shared):
    coverage = clean(cornell(shared, "garnet_red")).report.coverage
    np.testing.assert_allclose(np.degrees(coverage.theta_i), np.arange(10, 81, 10), atol=1e-4)
    assert not coverage.covers_both_half_planes
    text = "\n".join(coverage.missing)
    for expected in (
        "incident angles below 10 degrees",
        "incident angles above 80 degrees",
        "theta_o above 79.05 degrees",
        "azimuths 0 to 180 degrees: one half-plane only",
        "of the incidence direction",
    ):
        assert expected in text
    assert "mirror direction" not in text


def test_nist_coverage(shared):
    samples = formats.read(shared("data/nist-ptfe/PTFE.data.csv"), InputOptions(path="nist"))
    result = clean(samples)
    assert not result.report.flag.any() and result.samples.num_samples == 1824
    coverage = result.report.coverage
    np.testing.assert_allclose(np.degrees(coverage.theta_i), [0, 15, 30, 45, 60, 75], atol=0.002)
    assert coverage.covers_both_half_planes and not result.report.bilateral
    assert "incident angles above 75 degrees" in coverage.missing


def test_gaps_are_named(amber):
    few = amber.take(np.isin(np.round(np.degrees(amber.theta_i)), [0, 45]))
    assert any("between 0 and 45 degrees" in line for line in find_coverage(few).missing)
    assert any("fewer than 3 incident angles (2)" in line for line in find_coverage(few).missing)
    wedge = amber.take(np.abs(amber.phi_o - np.pi) < np.radians(60))
    assert any(line.startswith("|phi_o| between 0 and 12") for line in find_coverage(wedge).missing)
    plane = dataclasses.replace(amber, phi_o=np.where(amber.phi_o > np.pi, np.pi, 0.0))
    coverage = find_coverage(plane)
    assert not coverage.covers_both_half_planes and "everything off the plane of incidence" in coverage.missing
    lobe_only = amber.take(np.abs(amber.theta_o - amber.theta_i) > np.radians(12))
    assert any("of the mirror direction" in line for line in find_coverage(lobe_only).missing)


def test_incident_angles_cluster_by_span_not_by_chain(rng):
    jittered = np.radians(np.repeat([0.2, 30, 60.0], 50)) + np.radians(rng.uniform(-0.2, 0.2, 150))
    centre, index = cluster_incidences(jittered)
    np.testing.assert_allclose(np.degrees(centre), [0.2, 30, 60], atol=0.05)
    np.testing.assert_array_equal(index, np.repeat([0, 1, 2], 50))
    scattered = rng.uniform(0, np.pi / 2, 3000)
    centre, index = cluster_incidences(scattered)
    assert 150 < len(centre) <= 181 and (np.diff(centre) > 0).all()
    np.testing.assert_allclose(centre, [scattered[index == k].mean() for k in range(len(centre))])


# The command


def test_inspect_prints_coverage_and_flags(tmp_path, capsys, shared):
    assert main(["inspect", str(shared("data/cornell/garnet_red.brdf"))]) == 0
    out = capsys.readouterr().out
    for expected in (
        "a measurement, format pbrt, BRDF [1/sr]",
        "1439 samples x 31 wavelengths, 400 to 700 nm by 10 nm",
        "incident angles below 10 degrees",
        "zero (213 values)",
        "row 1435: theta_i 80, theta_o 79.047, phi_o 200 degrees",
    ):
        assert expected in out
    assert main(["inspect", str(tmp_path / "absent.h5")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_inspect_reads_a_written_sample(tmp_path, capsys):
    path = tmp_path / "sample.h5"
    assert main(["sample", "amber_glass", "--count", "30", "--noise", "0", "--output", str(path)]) == 0
    assert main(["inspect", str(path)]) == 0
    out = capsys.readouterr().out
    assert "format hdf5" in out and "390 of 390 samples kept" in out and "nothing was dropped" in out
