"""Small records with random numbers for tests of evaluation, metrics and the result file."""

import numpy as np

from sbrdf_jax.encoding import encode_field, make_basis
from sbrdf_jax.records import CompactBRDF, GriddedBRDF, SpectralField, Status

WAVELENGTH_NM = np.array([400.0, 430.0, 470.0, 500.0, 560.0, 600.0, 610.0, 700.0])  # uneven on purpose
UNIFORM_NM = np.linspace(380.0, 780.0, 11)


def small_grid(
    rng, *, window="factor", interpolate_theta_i=True, wavelength_nm=WAVELENGTH_NM, num_phi=12
) -> GriddedBRDF:
    """A grid of 5 x 5 x 13 nodes with the ties of a real one: one value at each pole, phi_o = 0 and 360 one node."""
    theta_i = np.linspace(0, np.pi / 2, 5) if interpolate_theta_i else np.deg2rad([20.0, 55.0])
    theta_o, phi_o = np.linspace(0, np.pi / 2, 5), np.linspace(0, 2 * np.pi, num_phi + 1)
    brdf = rng.uniform(0.0, 1.0, (len(theta_i), len(theta_o), len(phi_o), len(wavelength_nm)))
    brdf[:, 0] = brdf[:, 0, :1]
    if interpolate_theta_i:
        brdf[0] = brdf[0, :, :1]
    brdf[:, :, -1] = brdf[:, :, 0]
    lanes = len(wavelength_nm)
    return GriddedBRDF(
        theta_i,
        theta_o,
        phi_o,
        wavelength_nm,
        brdf,
        extrapolated=rng.integers(0, 3, brdf.shape[:3]),
        kkt_residual=rng.uniform(0, 1e-8, lanes),
        num_steps=rng.integers(100, 500, lanes),
        status=np.full(lanes, Status.OK),
        window=window,
        interpolate_theta_i=interpolate_theta_i,
    )


def small_field(gridded: GriddedBRDF, *, kind="fourier", coefficients=5) -> SpectralField:
    """Spectral coefficients of a grid, NumPy throughout."""
    field = encode_field(gridded, make_basis(np.asarray(gridded.wavelength_nm), kind, coefficients))
    return SpectralField(
        field.theta_i,
        field.theta_o,
        field.phi_o,
        np.asarray(field.coefficient),
        field.basis,
        gridded.window,
        gridded.interpolate_theta_i,
    )


def small_compact(
    rng,
    *,
    theta_i=None,
    interpolate_theta_i=True,
    kind="fourier",
    coefficients=5,
    max_degree=2,
    wavelength_nm=UNIFORM_NM,
) -> CompactBRDF:
    """A compact form with all lobe kinds, some lanes without a lobe."""
    theta_i = np.linspace(0, np.pi / 2, 5) if theta_i is None else theta_i
    basis = make_basis(wavelength_nm, kind, coefficients)
    lanes = (len(theta_i), np.shape(basis.synthesis)[0])
    lobe_kind = rng.integers(0, 4, lanes)
    no_lobe = lobe_kind == 0
    return CompactBRDF(
        theta_i=theta_i,
        basis=basis,
        background=rng.normal(size=(*lanes, (max_degree + 1) ** 2)),
        lobe_kind=lobe_kind,
        lobe_height=np.where(no_lobe, 0.0, rng.uniform(0.5, 2.0, lanes)),
        lobe_width=np.where(no_lobe, 1.0, rng.uniform(0.05, 0.3, lanes)),
        critical_angle=np.where(no_lobe, np.nan, rng.uniform(0.2, 0.8, lanes)),
        lobe_peak_theta_o=np.clip(theta_i + 0.05, 0, np.pi / 2),
        status=np.where(no_lobe, Status.NO_LOBE, Status.OK),
        max_degree=max_degree,
        interpolate_theta_i=interpolate_theta_i,
    )


def constant_compact(value, *, theta_i=None, wavelength_nm=UNIFORM_NM) -> CompactBRDF:
    """A compact form, coefficients = samples, that is `value` [wavelength] 1/sr in all directions."""
    theta_i = np.linspace(0, np.pi / 2, 5) if theta_i is None else theta_i
    lanes = (len(theta_i), len(wavelength_nm))
    background = np.broadcast_to(np.asarray(value) * np.sqrt(4 * np.pi), lanes)[..., None]  # Y_00 is 1 / sqrt(4 pi)
    return CompactBRDF(
        theta_i=theta_i,
        basis=make_basis(wavelength_nm, "identity", len(wavelength_nm)),
        background=np.array(background),
        lobe_kind=np.zeros(lanes, int),
        lobe_height=np.zeros(lanes),
        lobe_width=np.ones(lanes),
        critical_angle=np.full(lanes, np.nan),
        lobe_peak_theta_o=np.array(theta_i),
        status=np.full(lanes, Status.NO_LOBE),
        max_degree=0,
    )
