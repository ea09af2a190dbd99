"""Held-out validation: who is held out with whom and unseen, the scores, what is stored, printed and drawn."""

import dataclasses
import importlib.util

import h5py
import numpy as np
import pytest
from problems import scattered_samples
from small_results import small_grid

from sbrdf_jax import store
from sbrdf_jax.angles import half_angle
from sbrdf_jax.cleaning import clean
from sbrdf_jax.cli import main
from sbrdf_jax.errors import UserError
from sbrdf_jax.evaluation import evaluate
from sbrdf_jax.folds import K_FOLD, LEAVE_ONE_OUT, NO_FOLD, direction_groups, make_folds, read_fold_file
from sbrdf_jax.grid import make_grid
from sbrdf_jax.hdf5 import attribute, dataset_of, group_of
from sbrdf_jax.options import GridOptions, ResampleOptions, ValidateOptions
from sbrdf_jax.plan import plan_text, plan_validation
from sbrdf_jax.report import draw_figures
from sbrdf_jax.report.predictions import held_out
from sbrdf_jax.report.style import save_figure, style_context
from sbrdf_jax.resampling import resample
from sbrdf_jax.scores import SCORE_TEXT, held_out_scores, scores_by_half_angle
from sbrdf_jax.summary import summary_text, validation_table
from sbrdf_jax.validation import HeldOut, predict_held_out, score, validate

COARSE = GridOptions(theta_i_step_deg=30.0, theta_o_step_deg=22.5, phi_o_step_deg=45.0)
PAPER = ResampleOptions(method="paper", smoothness_weight=1.0, tolerance=1e-8)
BOTH = ValidateOptions(folds=3, leave_one_theta_i_out=True)


@pytest.fixture(scope="module")
def raw():
    """144 samples at 4 incident angles: one without a value, one below the horizon, one of no direction at all."""
    samples = scattered_samples(np.random.default_rng(4), [0.0, 30.0, 60.0, 80.0], 36, 3)
    samples.value[7, 1] = np.nan
    samples.theta_o[20] = np.deg2rad(95)
    samples.phi_o[50] = np.nan
    return samples


@pytest.fixture(scope="module")
def problem(raw):
    """The measurement, what cleaning says of it, and its grid."""
    cleaned = clean(raw)
    return raw, cleaned.report, make_grid(cleaned.samples, COARSE, bilateral=cleaned.report.bilateral)


@pytest.fixture(scope="module")
def validation(problem):
    """Both schemes at once, as a result holds them."""
    raw, report, grid = problem
    return validate(raw, make_folds(raw, report, BOTH), grid, PAPER, report)


def folds_of(raw, options: ValidateOptions, **kwargs):
    return make_folds(raw, clean(raw).report, options, **kwargs)


# ---- folds


def test_random_folds_are_even_seeded_and_of_directions_alone(raw):
    label = folds_of(raw, ValidateOptions(folds=5))[K_FOLD].label
    assert np.flatnonzero(label == NO_FOLD).tolist() == [20, 50]
    assert np.ptp(np.bincount(label[label != NO_FOLD])) <= 1
    changed = dataclasses.replace(raw, value=1.0 + raw.value[::-1])
    np.testing.assert_array_equal(folds_of(changed, ValidateOptions(folds=5))[K_FOLD].label, label)
    assert (folds_of(raw, ValidateOptions(folds=5, seed=1))[K_FOLD].label != label).any()


def with_twins(raw):
    """Every sample, its mirror twin, and itself once more a rounding away."""
    parts = [raw, dataclasses.replace(raw, phi_o=-raw.phi_o % (2 * np.pi)), dataclasses.replace(raw)]
    angles = {name: np.concatenate([getattr(p, name) for p in parts]) for name in ("theta_i", "theta_o", "phi_o")}
    angles["theta_o"][-len(raw.theta_o) :] += 4e-7
    value = np.concatenate([p.value for p in parts])
    return dataclasses.replace(raw, **angles, value=value, row=np.arange(len(value)))


def test_mirror_twins_and_repeats_stay_together(raw):
    many = with_twins(raw)
    label = folds_of(many, ValidateOptions(folds=4))[K_FOLD].label.reshape(3, -1)
    assert (label == label[0]).all()
    assert set(np.unique(label)) == {NO_FOLD, 0, 1, 2, 3}
    label = folds_of(many, ValidateOptions(folds=4), mirror_twins=False)[K_FOLD].label.reshape(3, -1)
    assert (label[2] == label[0]).all() and (label[1] != label[0]).any()


def test_directions_are_told_apart_but_for_azimuths_at_the_pole_and_whole_turns(raw):
    angles = np.array(
        [[0.5, 0.0, 1.0], [0.5, 0.0, 2.0], [0.5, 0.3, 0.0], [0.5, 0.3, 2 * np.pi - 1e-8], [0.5, 0.3, 1e-4]]
    )
    few = dataclasses.replace(raw.take(np.arange(5)), theta_i=angles[:, 0], theta_o=angles[:, 1], phi_o=angles[:, 2])
    group = direction_groups(few, mirror_twins=False)
    assert group[0] == group[1] and group[2] == group[3] and len(set(group.tolist())) == 3


def test_one_incident_angle_is_held_out_at_a_time(raw, rng):
    jitter = dataclasses.replace(raw, theta_i=raw.theta_i + np.deg2rad(rng.uniform(0, 0.4, raw.num_samples)))
    folds = folds_of(jitter, BOTH)[LEAVE_ONE_OUT]
    usable = folds.label != NO_FOLD
    np.testing.assert_array_equal(folds.label[usable], np.repeat(np.arange(4), 36)[usable])
    two = raw.take(raw.theta_i < 1)
    with pytest.raises(UserError, match="^validate.leave_one_theta_i_out: found 2 distinct incident angles"):
        folds_of(two, BOTH)


def test_folds_that_leave_too_little_are_refused(raw):
    few = raw.take(np.arange(5))
    with pytest.raises(UserError, match="^validate.folds: found 2 usable samples outside fold 0"):
        folds_of(few, ValidateOptions(folds=2))
    with pytest.raises(UserError, match="^validate.folds: found 7; expected at most 5"):
        folds_of(few, ValidateOptions(folds=7))
    bright = dataclasses.replace(raw, value=np.where(np.arange(raw.num_samples)[:, None] == 3, np.ones(3), -1.0))
    with pytest.raises(UserError, match="found 0 samples with a positive value outside fold"):
        folds_of(bright, ValidateOptions(folds=2))


def test_a_fold_file_wins_over_folds_and_may_come_in_any_order(raw, tmp_path):
    wanted = np.arange(raw.num_samples) % 2 * 7
    rows = np.random.default_rng(0).permutation(raw.num_samples)
    lines = [f"{raw.theta_i[row]:g}, {row} ,{wanted[row]}" for row in rows]
    path = tmp_path / "folds.csv"
    path.write_text("\n".join(["# by hand", "theta_i,row,fold", *lines, ""]))
    folds = folds_of(raw, ValidateOptions(folds=5, fold_file=str(path)))[K_FOLD]
    assert folds.labels.tolist() == [0, 7] and folds.how == "as in folds.csv"
    usable = folds.label != NO_FOLD
    assert usable.sum() == raw.num_samples - 2
    np.testing.assert_array_equal(folds.label[usable], wanted[usable])


GOOD = ["row,fold", "0,0", "1,1", "2,0", "3,1"]
WRONG_FOLD_FILES = {
    "row missing": ([*GOOD[:3], GOOD[4]], ":4: found no row 2; expected each of 0 to 3 once"),
    "rows missing": (GOOD[:2], ":2: found no row 1 and 2 more; expected"),
    "row twice": ([*GOOD, "1,1"], ":6: row: found 1 again; expected each row once"),
    "row out of range": ([*GOOD, "4,1"], ":6: row: found '4'; expected a whole number from 0 to 3"),
    "negative row": (["row,fold", "-1,0"], ":2: row: found '-1'; expected a whole number"),
    "row not whole": (["row,fold", "1.0,0"], ":2: row: found '1.0'; expected a whole number"),
    "fold not whole": (["row,fold", "1,half"], ":2: fold: found 'half'; expected a whole number"),
    "fold too large": (["row,fold", "1,99999999999999999999"], ":2: fold: found '99999999999999999999'"),
    "empty cell": (["row,fold", "1,"], ":2: fold: found ''"),
    "too few columns": (["x,row,fold", "1,0"], ":2: found 2 columns; expected 3 or more"),
    "no such column": (["row,part", "0,0"], ":1: header: found 'row,part'; expected one column fold"),
    "column twice": (["row,fold,row", "0,0,0"], ":1: header: found 'row,fold,row'; expected one column row"),
    "one fold": (["row,fold", "0,3", "1,3", "2,3", "3,3"], ":5: found the single fold 3; expected 2 folds or more"),
    "empty": ([], ":0: found no header; expected the columns row,fold"),
}


@pytest.mark.parametrize("case", WRONG_FOLD_FILES)
def test_wrong_fold_file_is_one_line_with_its_place(case, tmp_path):
    lines, said = WRONG_FOLD_FILES[case]
    path = tmp_path / "folds.csv"
    path.write_text("\n".join(lines))
    with pytest.raises(UserError) as caught:
        read_fold_file(str(path), 4)
    assert str(caught.value).startswith(f"{path}{said}") and "\n" not in str(caught.value)


def test_no_fold_file(tmp_path):
    with pytest.raises(UserError, match="^validate.fold_file: .*absent.csv: found no such file"):
        read_fold_file(str(tmp_path / "absent.csv"), 4)


def test_given_folds_of_the_measured_tables(shared):
    for name, count in (("folds.csv", 1439), ("folds-ptfe.csv", 1824)):
        label = read_fold_file(str(shared(f"cv/{name}")), count)
        assert np.unique(label).tolist() == [0, 1, 2, 3, 4]


# ---- predictions


def test_held_out_values_do_not_influence_their_own_prediction(problem):
    raw, report, grid = problem
    folds = folds_of(raw, ValidateOptions(folds=4))[K_FOLD]
    before = predict_held_out(raw, folds, grid, PAPER, bilateral=report.bilateral)
    wild = raw.value.copy()
    rows = np.flatnonzero(folds.label == 2)
    wild[rows] = np.resize([1e6, -5.0, 0.0, np.nan, 1e-9], (len(rows), 3))
    after = predict_held_out(dataclasses.replace(raw, value=wild), folds, grid, PAPER, bilateral=report.bilateral)
    np.testing.assert_array_equal(after.predicted[rows], before.predicted[rows])
    others = np.flatnonzero((folds.label != 2) & (folds.label != NO_FOLD))
    assert (after.predicted[others] != before.predicted[others]).any()


def test_a_prediction_is_the_fit_of_the_others_evaluated_there(problem, validation):
    raw, report, grid = problem
    folds = make_folds(raw, report, BOTH)[LEAVE_ONE_OUT]
    rows = np.flatnonzero(folds.label == 1)
    train = clean(raw.take(folds.label != 1), bilateral=report.bilateral).samples
    fitted = resample(train, grid, PAPER)
    expected = np.asarray(evaluate(fitted, raw.theta_i[rows], raw.theta_o[rows], raw.phi_o[rows]))
    # the length of a batch decides the order of its sums
    np.testing.assert_allclose(validation[f"{LEAVE_ONE_OUT}/predicted"][rows], expected, rtol=0, atol=1e-12)


def test_every_row_with_a_direction_is_predicted(raw, validation):
    for group in ("", f"{LEAVE_ONE_OUT}/"):
        finite = np.isfinite(validation[f"{group}predicted"])
        assert (finite == finite[:, :1]).all()
        assert np.flatnonzero(~finite[:, 0]).tolist() == [20, 50]
        np.testing.assert_array_equal(finite[:, 0], validation[f"{group}fold"] != NO_FOLD)
        assert validation[f"{group}scores/count"] == raw.num_samples - 3
        assert validation[f"{group}half_angle/count"].sum() == raw.num_samples - 3


def test_a_dead_wavelength_is_left_out_of_the_scores_alone(problem):
    raw, _, grid = problem
    value = raw.value.copy()
    value[:, 2] = np.nan
    dead = dataclasses.replace(raw, value=value)
    report = clean(dead).report
    found_out = predict_held_out(dead, folds_of(dead, BOTH)[K_FOLD], grid, PAPER, bilateral=report.bilateral)
    found = score(found_out, dead, report)
    assert found["scores/num_wavelengths"] == 2 and np.isfinite(found["scores/median_rel"])
    assert (found_out.status[:, 2] != 0).all() and (found_out.status[:, :2] == 0).all()


def test_progress_names_the_fold(problem):
    raw, report, grid = problem
    said = []
    folds = folds_of(raw, ValidateOptions(folds=2))[K_FOLD]
    predict_held_out(raw, folds, grid, PAPER, bilateral=report.bilateral, report=said.append)
    assert said[0].startswith("fold 1 of 2: ") and said[-1] == "fold 2 of 2: 3 of 3 wavelengths converged"


# ---- scores


def twin_scores(predicted, measured):
    """The formulae, written once more."""
    error = abs(predicted - measured)
    ratio = error[measured > 1e-3] / measured[measured > 1e-3]
    energy = np.sum(measured * measured, axis=1)
    calm = energy <= np.quantile(energy, 0.95)
    log_error = np.log(np.where(predicted > 0, predicted, 0) + 1e-3) - np.log(measured + 1e-3)
    return {
        "median_rel": np.quantile(ratio, 0.5),
        "p90_rel": np.quantile(ratio, 0.9),
        "calm_l2": np.linalg.norm(error[calm]) / np.linalg.norm(measured[calm]),
        "log_rms": np.linalg.norm(log_error) / np.sqrt(log_error.size),
        "rel_l2": np.linalg.norm(error) / np.linalg.norm(measured),
        "negative_share": np.count_nonzero(predicted < 0) / predicted.size,
    }


def random_values(rng):
    """Values over five decades, some of them 0, and predictions, some of them negative."""
    measured = 10 ** rng.uniform(-4, 1, (200, 4)) * (rng.random((200, 4)) > 0.1)
    return measured * rng.lognormal(0, 0.3, measured.shape) + 1e-3 * rng.normal(size=measured.shape), measured


def test_scores_equal_the_formulae(rng):
    predicted, measured = random_values(rng)
    found = held_out_scores(predicted, measured)
    assert list(found) == list(SCORE_TEXT)
    assert found == pytest.approx(twin_scores(predicted, measured), rel=1e-12)
    noisy = np.where(measured == 0, -1e-4, measured)  # a negative value counts as 0
    assert held_out_scores(predicted, noisy) == found


def test_scores_equal_the_reference_script(rng, shared):
    spec = importlib.util.spec_from_file_location("reference_score", shared("cv/score.py"))
    assert spec is not None and spec.loader is not None
    reference = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(reference)
    predicted, measured = random_values(rng)
    expected = reference.score(predicted, measured)
    expected["negative_share"] = expected.pop("negative")
    assert held_out_scores(predicted, measured) == pytest.approx(expected, rel=1e-12)


def test_scores_by_half_angle_are_those_of_each_bin(rng):
    predicted, measured = random_values(rng)
    angle = np.deg2rad(rng.permutation(np.concatenate([[0.0, 1.0, 90.0], rng.uniform(0, 29, 197)])))
    found = scores_by_half_angle(predicted, measured, angle)
    assert found["count"].sum() == 200 and found["count"][-1] == 1
    deg = np.degrees(angle)
    inside = (deg >= 5) & (deg < 15)
    assert found["lower_deg"][2] == 5 and found["count"][2] == inside.sum()
    expected = twin_scores(predicted[inside], measured[inside])
    assert {name: found[name][2] for name in SCORE_TEXT} == pytest.approx(expected, rel=1e-12)
    empty = scores_by_half_angle(predicted, measured, 0 * angle)
    assert empty["count"].tolist() == [200, 0, 0, 0, 0] and np.isnan(empty["median_rel"][1:]).all()


def test_nothing_above_the_floor_has_no_relative_error():
    found = held_out_scores(np.full((3, 2), 1e-4), np.zeros((3, 2)))
    assert np.isnan(found["median_rel"]) and np.isinf(found["rel_l2"]) and found["log_rms"] > 0


def test_half_angle_is_that_of_the_half_vector(rng):
    theta_i, theta_o, phi_o = rng.uniform(0, 1.5, 50), rng.uniform(0, 1.5, 50), rng.uniform(0, 6.28, 50)
    incoming = np.stack([np.sin(theta_i), 0 * theta_i, np.cos(theta_i)])
    outgoing = np.stack([np.sin(theta_o) * np.cos(phi_o), np.sin(theta_o) * np.sin(phi_o), np.cos(theta_o)])
    half = incoming + outgoing
    np.testing.assert_allclose(half_angle(theta_i, theta_o, phi_o), np.arccos(half[2] / np.linalg.norm(half, axis=0)))
    near_mirror = half_angle(np.array([0.7]), np.array([0.7 + 2e-9]), np.array([np.pi]))
    np.testing.assert_allclose(near_mirror, 1e-9, rtol=1e-6)


# ---- the result


@pytest.fixture(scope="module")
def result(raw, problem, validation):
    grid = small_grid(np.random.default_rng(2), wavelength_nm=raw.wavelength_nm)
    grid = dataclasses.replace(grid, method="guided")  # the figures of interpolation are drawn elsewhere
    return store.RunResult(gridded=grid, clean=problem[1], validation=validation)


def test_validation_comes_back_from_the_store(result, raw, tmp_path):
    store.save(tmp_path / "held.h5", result)
    back = store.load(tmp_path / "held.h5").validation
    assert set(back) == set(result.validation)
    for name, value in result.validation.items():
        np.testing.assert_array_equal(back[name], value, err_msg=name)
    with h5py.File(tmp_path / "held.h5") as file:
        for group in ("validation", f"validation/{LEAVE_ONE_OUT}"):
            inner = group_of(file, group)
            predicted = dataset_of(inner, "predicted")
            assert predicted.shape == raw.value.shape and predicted.attrs["units"] == "1/sr"
            scales = [str(scale.name).rsplit("/", 1)[-1] for dim in predicted.dims for scale in dim.values()]
            assert scales == ["row", "wavelength_nm"]
            assert "median" in attribute(dataset_of(inner, "scores/median_rel"), "meaning")
            assert [scale.size for scale in dataset_of(inner, "half_angle/median_rel").dims[0].values()] == [5]


def test_scores_are_printed_and_inspected(result, raw, tmp_path, capsys):
    table = validation_table(result)
    names = [row[0].strip() for row in table.rows]
    assert names[0] == "folds, 3 fits" and names[1] == "half angle 0 to 1 deg" and names[6] == "one theta_i out, 4 fits"
    assert table.rows[0][1] == str(raw.num_samples - 3) and len(table.rows) == 12
    assert float(table.rows[0][2]) == pytest.approx(100 * result.validation["scores/median_rel"], rel=1e-2)
    store.save(tmp_path / "held.h5", result)
    assert main(["inspect", str(tmp_path / "held.h5")]) == 0
    assert "Held-out predictions" in capsys.readouterr().out
    assert "Held-out" not in summary_text(dataclasses.replace(result, validation={}))


def test_plan_counts_the_fits(raw):
    text = plan_text(plan_validation(folds_of(raw, BOTH)))
    assert "at random, seed 0, mirror twins and repeats together" in text and "one incident angle held out" in text
    assert [row.needed for row in plan_validation(folds_of(raw, BOTH))] == [3, 4]
    assert folds_of(raw, ValidateOptions()) == {}


def test_predictions_are_drawn_with_and_without_samples(result, raw, tmp_path):
    samples = clean(raw).samples
    assert "held_out.png" in [path.name for path in draw_figures(result, tmp_path)]
    dark = HeldOut(np.full(raw.value.shape, -1.0), np.zeros(raw.num_samples, int), np.zeros((1, 3), int))
    scored = vars(dark) | score(dark, dataclasses.replace(raw, value=0 * raw.value), result.clean)
    with style_context():
        save_figure(held_out(result.validation, samples), tmp_path / "both.png")
        save_figure(held_out(scored, dataclasses.replace(samples, value=0 * samples.value)), tmp_path / "dark.png")
