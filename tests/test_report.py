"""The report: what figures read off a grid, the files that are drawn, the page, the summary, and the command."""

import dataclasses
import html.parser
import re
import sys

import matplotlib
import numpy as np
import pytest
from small_results import small_compact, small_field, small_grid

from sbrdf_jax import builtin, colour, config, store
from sbrdf_jax.cleaning import clean
from sbrdf_jax.cli import main
from sbrdf_jax.evaluation import evaluate, evaluate_on_axes
from sbrdf_jax.lobes import LOBE_KINDS
from sbrdf_jax.metrics import measure
from sbrdf_jax.report import draw_figures, fine_grid, hemisphere, lobe_fits, page, write_page
from sbrdf_jax.store import RunResult
from sbrdf_jax.summary import error_table, summary_text, table_text, time_table

WAVELENGTH_NM = np.linspace(400.0, 700.0, 11)
PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture(scope="module")
def raw():
    """A small simulated measurement."""
    samples = builtin.measure("amber_glass", count=1300)
    keep = np.argmin(np.abs(samples.wavelength_nm[:, None] - WAVELENGTH_NM), axis=0)
    return dataclasses.replace(samples, wavelength_nm=samples.wavelength_nm[keep], value=samples.value[:, keep])


@pytest.fixture(scope="module")
def result(raw):
    """A result on a coarse grid that holds the truth, with a random compact form: quick, and everything is there."""
    rng = np.random.default_rng(5)
    grid = small_grid(rng, wavelength_nm=raw.wavelength_nm)
    theta_i, theta_o, phi_o = np.meshgrid(grid.theta_i, grid.theta_o, grid.phi_o, indexing="ij")
    brdf = builtin.true_brdf("amber_glass", theta_i, theta_o, phi_o, raw.wavelength_nm)
    flags = np.array(grid.extrapolated)
    flags[-1] = 2
    grid = dataclasses.replace(grid, brdf=brdf, extrapolated=flags)
    compact = small_compact(rng, wavelength_nm=raw.wavelength_nm)
    metrics = {
        "relative_error": np.array([0.03, 0.05, 0.2, 0.4, 0.6]),
        "relative_error_between": np.array([0.04, 0.06, 0.2, np.inf, 0.6]),
        "relative_error_near_mirror": np.array([0.05, 0.06, 0.2, 0.3, 0.6]),
        "error_spectral": np.array([0.01, 0.0, 0.01, 0.01, 0.01]),
        "error_lobe": np.array([0.02, 0.04, 0.1, 0.3, np.nan]),
        "relative_error_overall": np.array(0.33),
        "albedo": np.linspace(0.2, 1.2, 55).reshape(5, 11),
        "compression_ratio": np.array(12.5),
    }
    options = config.resolve(config.parse_config("input: {path: 'builtin:amber_glass'}\n"))
    return RunResult(
        gridded=grid,
        field=small_field(grid),
        compact=compact,
        metrics=metrics,
        clean=clean(raw).report,
        input={"source": "amber <glass>", "quantity": "brdf", "notes": ["a note & more"]},
        timing={"resample": {"total": 12.0, "compile": 2.0, "run": 10.0}, "measure": {"total": 0.5, "run": 0.5}},
        warnings=("albedo <b>above</b> 1",),
        config=config.resolved_yaml(options),
        source_sha256=raw.source_sha256,
    )


@pytest.fixture(scope="module")
def plain(result):
    """A result with few figures: its grid is not read as the paper's, and there is nothing but the grid."""
    grid = dataclasses.replace(result.gridded, method="guided")
    return dataclasses.replace(result, gridded=grid, field=None, compact=None, metrics={}, clean=None, config="")


def fit_in_no_time(part, options):
    """Stands in for `represent`, whose compilation would take most of the time of these tests."""
    count = np.shape(part.basis.synthesis)[0]
    return small_compact(
        np.random.default_rng(LOBE_KINDS.index(options.lobe)), theta_i=np.asarray(part.theta_i), coefficients=count,
        interpolate_theta_i=False, max_degree=options.max_degree, wavelength_nm=np.asarray(part.basis.wavelength_nm),
    )  # fmt: skip


@pytest.fixture(scope="module")
def drawn(result, raw, tmp_path_factory):
    """The page of one result, drawn once for all tests that look at it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lobe_fits, "represent", fit_in_no_time)
        return write_page([("glass", result)], tmp_path_factory.mktemp("report") / "glass", clean(raw).samples)


class Outline(html.parser.HTMLParser):
    """Tags that are open, and everything that would be fetched."""

    VOID = ("meta", "img", "br", "hr", "link", "input")

    def __init__(self):
        super().__init__()
        self.open, self.sources, self.tags, self.text = [], [], [], []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.sources += [value for name, value in attrs if name in ("src", "href")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def outline(path):
    parser = Outline()
    parser.feed(path.read_text(encoding="utf-8"))
    assert parser.open == []
    return parser


def test_every_figure_is_drawn_and_embedded(drawn):
    names = sorted(path.stem for path in drawn.parent.glob("*.png"))
    assert names == [
        "albedo", "cleaning", "color_maps", "coverage", "cutoff", "errors", "lobe_kinds", "plane_of_incidence",
        "ring_effect", "solver", "spectra",
    ]  # fmt: skip
    assert all(path.read_bytes().startswith(PNG) for path in drawn.parent.glob("*.png"))
    page_outline = outline(drawn)
    assert sum(source.startswith("data:image/png;base64,") for source in page_outline.sources) == len(names)


def test_page_is_self_contained_and_escapes_what_it_shows(drawn):
    found = outline(drawn)
    assert "script" not in found.tags and "link" not in found.tags
    assert all(source.startswith(("data:", "#")) for source in found.sources)
    text = drawn.read_text(encoding="utf-8")
    assert not re.search(r"url\(|@import|https?://", text)
    assert "prefers-color-scheme: dark" in text
    assert "albedo <b>above</b> 1" in "".join(found.text) and "amber <glass>" in "".join(found.text)
    for title in ("What came in", "What was done", "Cleaning", "Statuses", "Time"):
        assert title in found.text


def test_drawing_leaves_no_trace_and_is_reproducible(plain, tmp_path):
    before = dict(matplotlib.rcParams)
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    first, second = (draw_figures(plain, tmp_path / name) for name in "ab")
    assert dict(matplotlib.rcParams) == before
    pyplot = sys.modules.get("matplotlib.pyplot")  # colour-science imports it; this project never does
    assert pyplot is None or pyplot.get_fignums() == []
    names = ["plane_of_incidence.png", "color_maps.png", "ring_effect.png", "coverage.png", "solver.png"]
    assert [path.name for path in first] == [path.name for path in second] == names
    assert all(a.read_bytes() == b.read_bytes() for a, b in zip(first, second, strict=True))


def test_two_results_share_a_page(plain, tmp_path):
    grid = small_grid(np.random.default_rng(1), interpolate_theta_i=False)
    bare = RunResult(gridded=dataclasses.replace(grid, method="guided"), input={"quantity": "relative"})
    path = write_page([("my glass", plain), ("my glass", bare)], tmp_path / "both")
    names = {file.name for file in path.parent.glob("*.png")}
    assert {"my-glass_solver.png", "my-glass-2_solver.png"} <= names
    found = outline(path)
    assert "#my-glass-2" in found.sources
    assert "The result holds no config" in "".join(found.text)


def test_samples_come_from_an_unchanged_source_only(result, raw):
    whole = builtin.measure("amber_glass")
    samples, missing = page.cleaned_samples(dataclasses.replace(result, source_sha256=whole.source_sha256))
    assert missing == "" and samples is not None and samples.num_samples == whole.num_samples
    changed = dataclasses.replace(result, source_sha256="0" * 64)
    assert "has changed" in page.cleaned_samples(changed)[1]
    lost = dataclasses.replace(result, config=result.config.replace("builtin:amber_glass", "/nowhere/glass.csv"))
    samples, missing = page.cleaned_samples(lost)
    assert samples is None and "/nowhere/glass.csv" in missing


def test_fine_grid_is_the_interpolation_of_the_spectra_and_their_colours(result):
    fine = fine_grid.interpolate_finely(result.gridded, num_theta=7, num_phi=9)
    theta_i = np.array([incidence.value for incidence in fine.incidences])
    matching = colour.colour_matching(np.asarray(result.gridded.wavelength_nm))
    for values, window in ((fine.plain, "none"), (fine.windowed, "factor")):
        grid = dataclasses.replace(result.gridded, window=window)
        spectra = evaluate_on_axes(grid, theta_i, fine.theta_o, fine.phi_o)
        np.testing.assert_allclose(values[..., 0], spectra[..., fine.wavelength.index], atol=1e-13)
        np.testing.assert_allclose(values[..., 1:], colour.brdf_to_srgb(spectra, matching, gamma=False), atol=1e-11)
    angle, value = fine.plane(fine.plain, 1)
    np.testing.assert_allclose(angle, np.linspace(-np.pi / 2, np.pi / 2, 13), atol=1e-15)
    assert value[0] == fine.plain[1, -1, 0, 0] and value[-1] == fine.plain[1, -1, 4, 0]


def test_the_nearest_wavelength_and_incidence_say_so(result):
    assert fine_grid.pick_wavelength(np.array([500.0, 548.0, 556.0])).text == "548 nm (nearest to 550 nm)"
    assert fine_grid.pick_wavelength(np.array([500.0, 550.0])) == (1, 550.0, "550 nm")
    assert [p.text for p in fine_grid.pick_incidences(result.gridded)] == ["0°", "22.5° (for 15°)", "45°"]


def test_total_variation_of_known_fields():
    theta, phi = np.linspace(0, np.pi / 2, 181), np.linspace(0, 2 * np.pi, 361)
    up, along = np.cos(theta)[:, None] + 0 * phi, np.sin(theta)[:, None] * np.cos(phi)
    # |grad z| = sin(theta) and |grad x| is the same about the x axis: both integrate to pi^2 / 2
    assert fine_grid.total_variation(up, theta, phi) == pytest.approx(np.pi**2 / 2, rel=1e-4)
    assert fine_grid.total_variation(along, theta, phi) == pytest.approx(np.pi**2 / 2, rel=1e-3)
    assert fine_grid.total_variation(0 * up + 3.0, theta, phi) == 0.0


def test_the_window_calms_the_rings():
    axis = [np.radians(np.arange(0, n + 1, 7.5)) for n in (90, 90, 360)]
    theta_i, theta_o, phi_o = np.meshgrid(*axis, indexing="ij")
    brdf = builtin.true_brdf("amber_glass", theta_i, theta_o, phi_o, np.array([550.0, 600.0]))
    grid = dataclasses.replace(
        small_grid(np.random.default_rng(0)), theta_i=axis[0], theta_o=axis[1], phi_o=axis[2], brdf=brdf,
        wavelength_nm=np.array([550.0, 600.0]), extrapolated=np.zeros(brdf.shape[:3], int),
    )  # fmt: skip
    effect = fine_grid.ring_effect(grid, fine_grid.interpolate_finely(grid))
    assert effect.nodes < effect.windowed < 0.95 * effect.plain


def test_pictures_have_the_mirror_side_to_the_right():
    theta, phi = np.linspace(0, 1, 46), np.linspace(0, 2 * np.pi, 91)
    right = -np.cos(phi)[None, :] * theta[:, None]
    image = hemisphere.disk_image(right[..., None], pixels=101)[..., 0]
    across = (np.arange(101) + 0.5) / 101 * 2 - 1
    inside = np.isfinite(image)
    np.testing.assert_allclose(image[inside], np.broadcast_to(across, image.shape)[inside], atol=3e-3)
    assert not inside[0, 0] and inside[50, 50]
    nodes = hemisphere.node_image(np.repeat(right[..., None], 3, axis=-1), pixels=101)
    assert nodes[50, 95, 0] > 0.8 and nodes[50, 5, 0] < -0.8 and nodes[0, 0, 3] == 0


def test_screen_values_are_those_of_colour_science():
    import colour as colour_science

    linear = np.linspace(0, 1, 101)
    np.testing.assert_allclose(hemisphere.encode_srgb(linear), colour_science.cctf_encoding(linear), atol=1e-6)


def test_lobe_kinds_are_fitted_one_by_one_at_one_incidence(result, monkeypatch):
    asked = []

    def represent(part, options):
        asked.append((np.shape(part.coefficient)[0], part.interpolate_theta_i, options.max_degree, options.lobe))
        return fit_in_no_time(part, options)

    monkeypatch.setattr(lobe_fits, "represent", represent)
    fits = lobe_fits.fit_lobe_kinds(result.field, result.gridded, 2, (1, 2))
    assert asked == [(1, False, degree, kind) for degree in (1, 2) for kind in LOBE_KINDS[1:]]
    grid = result.gridded
    mesh = np.meshgrid(grid.theta_i[2:3], grid.theta_o, grid.phi_o, indexing="ij")
    value = np.asarray(evaluate(fits[4].compact, *mesh))
    eta = np.linalg.norm(value - grid.brdf[2:3]) / np.linalg.norm(grid.brdf[2:3])
    assert fits[4].error == pytest.approx(eta, rel=1e-12)


@pytest.mark.slow
def test_lobe_kinds_with_the_real_fit(result):
    fits = lobe_fits.fit_lobe_kinds(result.field, result.gridded, 0, (1,))
    assert [fit.kind for fit in fits] == list(LOBE_KINDS[1:])
    assert all(0 < fit.error < 0.2 for fit in fits)


def test_summary_names_every_incident_angle_however_bad(result):
    text = summary_text(result)
    for row in ("What came in", "What was done", "incident angle", "Time", "albedo <b>above</b> 1", "a note & more"):
        assert row in text
    rows = error_table(result).rows
    assert [row[0] for row in rows] == ["0", "22.5", "45", "67.5", "90 *", "all"]
    assert rows[0][1:] == ("3", "4", "5", "1", "2") and rows[3][2] == "inf" and rows[4][5] == "-"
    assert rows[-1][1:] == ("33", "", "", "", "")
    assert time_table(result).rows[-1] == ("all", "12 s", "2.0 s", "10 s")
    lines = table_text(time_table(result)).splitlines()
    assert lines[0] == "Time" and len({len(line) for line in lines[1:]}) == 1


def test_a_measured_result_fits_the_summary(result):
    measured = measure(result.gridded)
    text = summary_text(dataclasses.replace(result, metrics=measured.value, compact=None))
    assert "negative" not in text.split("Time")[1] and "grid < 0" in text


def test_command_writes_a_report_of_a_stored_result(plain, tmp_path, capsys):
    store.save(tmp_path / "glass.h5", plain)
    assert main(["report", str(tmp_path / "glass.h5"), "--output", str(tmp_path / "out")]) == 0
    assert capsys.readouterr().out.strip() == str(tmp_path / "out" / "index.html")
    assert (tmp_path / "out" / "solver.png").exists()


@pytest.mark.parametrize("what", ["missing", "output is a file"])
def test_command_refuses_in_one_line(plain, tmp_path, capsys, what):
    stored = tmp_path / "glass.h5"
    if what == "output is a file":
        store.save(stored, plain)
        (tmp_path / "out").write_text("here before")
    assert main(["report", str(stored), "--output", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and ("glass.h5" in error or str(tmp_path / "out") in error)
    assert sorted(p.name for p in tmp_path.iterdir()) in ([], ["glass.h5", "out"])
