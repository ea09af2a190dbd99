"""Readers and writers of measurements: real files against plain twins, wrong and hostile files one by one, fuzzing."""

import csv
import dataclasses
import struct

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sbrdf_jax import builtin, formats
from sbrdf_jax.errors import UserError
from sbrdf_jax.formats import isolated, raw_hdf5, table, text
from sbrdf_jax.options import InputOptions
from sbrdf_jax.records import RawSamples

PBRT = """# a paint
2   # wavelengths
500
600
0.1 0 0.2 3.0  0.5 0.6
0.1 0 0.3 -3.0
 0.4 0.7   # a row may wrap
0.5 1.0 0.3 2.0  0.3 0.8
1.2 0 0.3 0.0  0.2 0.9
"""
CSV = """# quantity: brdf
theta_i_deg,theta_o_deg,phi_o_deg,500nm,600nm
0,10,0,0.1,0.2
10,20,90,0.3,0.4
20,30,180,0.5,0.6
30,40,270,0.7,nan
"""
NIST = "lambda,thetai,phi,thetar,phir,f_r11,f_r12/f_r11\n" + "".join(
    f"{wavelength},{-theta},0,{theta + 5},{phi},{0.3 + wavelength},0.01\n"
    for wavelength in (0.633, 0.532)
    for theta, phi in ((0.001, 0), (15, 10), (30, -20), (45, 180))
)


def options(**changes) -> InputOptions:
    return InputOptions(path="unused", **changes)


def read_text(tmp_path, content, **changes) -> RawSamples:
    path = tmp_path / "measured.dat"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return formats.read(path, options(**changes))


def write_raw(path, *, attributes=None, **datasets):
    """Write the project's raw HDF5 with some of it replaced, None leaving it out."""
    arrays = {"theta_i_deg": [0.0, 10, 20, 30], "theta_o_deg": [10.0, 20, 30, 40], "phi_o_deg": [0.0, 90, 180, 270]}
    arrays |= {"wavelength_nm": [500.0, 600], "value": np.arange(1.0, 9).reshape(4, 2) / 10}
    named = {"schema_name": "sbrdf-raw", "schema_version": 1, "quantity": "brdf", "mirror_azimuth_deg": 180}
    with h5py.File(path, "w") as file:
        for name, array in (arrays | datasets).items():
            if array is not None:
                file.create_dataset(name, data=array)
        for name, value in (named | (attributes or {})).items():
            if value is not None:
                file.attrs[name] = value
    return path


# What is read


@pytest.mark.parametrize("name", ["garnet_red", "cayman", "acryl_blue"])
def test_cornell_files_equal_a_plain_reading(shared, name):
    path = shared(f"data/cornell/{name}.brdf")
    words = [float(word) for line in path.read_text().splitlines() for word in line.split("#")[0].split()]
    count = int(words[0])
    rows = np.array(words[1 + count :]).reshape(-1, 4 + count)
    found = formats.read(path, options())
    assert (found.source_format, found.quantity, found.num_samples) == ("pbrt", "brdf", 1439)
    np.testing.assert_array_equal(found.wavelength_nm, words[1 : 1 + count])
    np.testing.assert_array_equal(found.value, rows[:, 4:])
    np.testing.assert_array_equal(found.theta_i, rows[:, 0])
    np.testing.assert_allclose(np.cos(found.phi_o), np.cos(rows[:, 3] - rows[:, 1]), atol=1e-12)
    brightest = found.phi_o[np.argmax(found.value.sum(axis=1))]
    assert np.degrees(brightest) == pytest.approx(180, abs=1e-3)


def test_nist_file_equals_a_plain_reading(shared):
    path = shared("data/nist-ptfe/PTFE.data.csv")
    with open(path, newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["lambda"] == "0.532"]
    found = formats.read(path, options())
    assert (found.source_format, found.value.shape) == ("nist", (1824, 4))
    np.testing.assert_allclose(found.wavelength_nm, [351, 532, 633, 1064])
    np.testing.assert_array_equal(found.value[:, 1], [float(row["f_r11"]) for row in rows])
    np.testing.assert_allclose(np.degrees(found.theta_i), [abs(float(row["thetai"])) for row in rows])
    shifted = [(float(row["phir"]) + 180) % 360 for row in rows]
    np.testing.assert_allclose(np.degrees(found.phi_o), shifted, atol=1e-9)


def test_rows_wrap_and_azimuths_are_relative_to_incidence(tmp_path):
    found = read_text(tmp_path, PBRT)
    assert found.source_format == "pbrt" and found.row.tolist() == [0, 1, 2, 3]
    np.testing.assert_allclose(found.value, [[0.5, 0.6], [0.4, 0.7], [0.3, 0.8], [0.2, 0.9]])
    np.testing.assert_allclose(found.phi_o, [3.0, 2 * np.pi - 3, 1.0, 0.0])


def test_nist_turns_the_mirror_to_180_and_micrometres_to_nm(tmp_path):
    found = read_text(tmp_path, NIST)
    np.testing.assert_allclose(found.wavelength_nm, [532, 633])
    np.testing.assert_allclose(found.value[0], [0.832, 0.933])
    np.testing.assert_allclose(np.degrees(found.theta_i), [0.001, 15, 30, 45])
    np.testing.assert_allclose(np.degrees(found.phi_o), [180, 190, 160, 0], atol=1e-12)


def test_csv_keeps_nan_and_sorts_wavelengths(tmp_path):
    found = read_text(tmp_path, CSV.replace("500nm,600nm", "600.5nm, 500 nm"))
    np.testing.assert_allclose(found.wavelength_nm, [500, 600.5])
    np.testing.assert_array_equal(found.value, [[0.2, 0.1], [0.4, 0.3], [0.6, 0.5], [np.nan, 0.7]])
    assert any("sorted" in note for note in found.notes)
    assert any("whole" in note for note in read_text(tmp_path, CSV.rstrip("\n")).notes)
    with_bom = read_text(tmp_path, b"\xef\xbb\xbf" + CSV.replace("\n", "\r\n").encode())
    assert with_bom.source_format == "csv" and with_bom.num_samples == 4


@pytest.mark.parametrize(
    ("quantity", "factor"),
    [("brdf", 1.0), ("relative", 1.0), ("reflectance_factor", 1 / np.pi), ("brdf_cos", None)],
)
def test_quantity_and_scale(tmp_path, quantity, factor):
    grazing = CSV + "40,89,180,0.5,0.5\n"
    plain = read_text(tmp_path, grazing)
    if factor is None:
        floor = np.cos(np.radians(85))
        factor = 1 / np.maximum(np.cos(plain.theta_o), floor)[:, None]
        assert factor[-1] == pytest.approx(1 / floor)
    for found in (
        read_text(tmp_path, grazing, quantity=quantity, scale=2.0),
        read_text(tmp_path, grazing.replace("quantity: brdf", f"quantity: {quantity}"), scale=2.0),
    ):
        np.testing.assert_allclose(found.value, 2 * factor * plain.value)
        assert found.quantity == ("relative" if quantity == "relative" else "brdf")
    # the config wins over the file, and that is said
    assert any("the file says" in note for note in read_text(tmp_path, grazing, quantity="brdf_cos").notes)


def test_mirror_azimuth(tmp_path):
    turned = [180, 270, 0, 90]
    by_option = read_text(tmp_path, CSV, mirror_azimuth_deg=0)
    by_comment = read_text(tmp_path, "# mirror_azimuth_deg: 0\n" + CSV)
    by_attribute = formats.read(write_raw(tmp_path / "a.h5", attributes={"mirror_azimuth_deg": 0}), options())
    for found in (by_option, by_comment, by_attribute):
        np.testing.assert_allclose(np.degrees(found.phi_o), turned, atol=1e-12)


def test_a_mirror_on_the_wrong_side_is_noted(shared):
    path = shared("data/cornell/garnet_red.brdf")
    assert not formats.read(path, options()).notes
    notes = formats.read(path, options(mirror_azimuth_deg=0)).notes
    assert any("mirror_azimuth_deg right" in note for note in notes)


def test_a_format_that_does_not_say_is_refused(tmp_path):
    path = write_raw(tmp_path / "a.h5", attributes={"quantity": None})
    with pytest.raises(UserError, match="input.quantity is auto, expected brdf, brdf_cos"):
        formats.read(path, options())
    assert formats.read(path, options(quantity="brdf")).quantity == "brdf"


def test_builtin_is_read_by_name():
    found = formats.read("builtin:amber_glass_broad", options(scale=3.0))
    expected = builtin.measure("amber_glass_broad")
    np.testing.assert_allclose(found.value, 3 * expected.value, rtol=1e-15)
    np.testing.assert_allclose(found.phi_o, expected.phi_o, atol=1e-15)
    assert (found.source, found.source_format) == ("builtin:amber_glass_broad", "builtin")
    with pytest.raises(UserError, match="no such embedded material"):
        formats.read("builtin:amber", options())


def test_relative_paths_start_from_base(tmp_path, monkeypatch):
    (tmp_path / "measured.dat").write_text(CSV)
    assert formats.read("measured.dat", options(), base=tmp_path).num_samples == 4
    monkeypatch.chdir(tmp_path)
    assert formats.read("measured.dat", options()).num_samples == 4


# What a file is


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (PBRT, "pbrt"),
        (CSV, "csv"),
        ('"theta_i_deg","theta_o_deg","phi_o_deg","500nm"\n', "csv"),
        (NIST, "nist"),
        (b"tensor_file\0\1\0" + bytes(20), "rgl-bsdf"),
        (struct.pack("<3i", 90, 90, 180) + bytes(80), "merl"),
        ("ASTM 1\nVARS theta_i,phi_i,theta_s,phi_s,400nm\n0,0,0,0,1\n", "astm"),
        ("#pgII [uA]\n#intheta\t10\n1\t2\t3\n", "pab"),
        (" Incident_angle,Measure_angle, 390nm \n10,10,1\n", "inplane"),
        ("#DIM 2 3\n#PARAM_IN RUSIN_TH_TD\n1 2 3\n", "alta"),
    ],
)
def test_detection_looks_at_content(tmp_path, content, expected):
    path = tmp_path / "any.brdf"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    assert formats.detect(path) == expected
    if expected in formats.NOT_YET:
        for chosen in ("auto", expected):
            with pytest.raises(UserError, match=f"format {expected}: not available yet, expected one of pbrt, csv"):
                formats.read(path, options(format=chosen))


def test_real_files_of_other_formats_are_named(shared):
    for name, expected in (
        ("data/pab/golden_paper_reduced.txt", "pab"),
        ("data/spectral-inplane/inplane_35wl.csv", "inplane"),
        ("data/rgl-rgb/cc_ibiza_sunset_rgb.bsdf", "rgl-bsdf"),
        ("data/cornell/cayman.brdf", "pbrt"),
        ("data/nist-ptfe/PTFE.data.csv", "nist"),
    ):
        assert formats.detect(shared(name)) == expected


# Wrong text files, one by one

ROW = "30,40,270,0.7,nan\n"
WRONG_TEXT = [
    ("empty", "", {}, "found an empty file"),
    ("unknown text", "hello world\n", {}, ":1: found 'hello world', expected the start of one of pbrt"),
    ("only comments", "# nothing\n\n", {}, "expected the start of one of pbrt"),
    ("not UTF-8", CSV.encode() + b"1,2,3,\xff,5\n", {}, ":7: found byte 0xff, expected UTF-8"),
    ("UTF-16", CSV.encode("utf-16"), {"format": "csv"}, ":1: found byte 0xff, expected UTF-8"),
    ("pbrt: text among numbers", PBRT.replace("0.4 0.7", "0.4 O.7"), {}, ":7: found 'O.7', expected a number"),
    ("pbrt: underscore", PBRT.replace("0.4 0.7", "0.4 1_0"), {}, ":7: found '1_0', expected a number"),
    ("pbrt: cut short", PBRT[: PBRT.rindex("0.2 0.9")], {}, ":9: found 4 numbers after 3 rows, expected 6"),
    ("pbrt: only its head", "3\n400 500\n", {}, ":2: found 2 wavelengths, expected 3"),
    ("pbrt: bad count", PBRT.replace("2   #", "2.5 #"), {}, ":2: count of wavelengths: found 2.5"),
    ("pbrt: negative count", PBRT.replace("2   #", "-2 #"), {}, "count of wavelengths: found -2"),
    ("pbrt: huge count", PBRT.replace("2   #", "1e300 #"), {}, "count of wavelengths: found 1e+300"),
    ("pbrt: count is nan", PBRT.replace("2   #", "nan #"), {}, "count of wavelengths: found nan"),
    ("pbrt: comments only", "# nothing\n", {"format": "pbrt"}, "found no number, expected the count"),
    (
        "pbrt: degrees",
        PBRT.replace("0.5 1.0 0.3", "50 0 30"),
        {},
        ":8: theta_i: found 50, expected 0 to 1.5708 rad; the",
    ),
    ("pbrt: azimuth in degrees", PBRT.replace("-3.0", "-175"), {}, ":6: phi_o: found -175, expected an azimuth in rad"),
    (
        "pbrt: micrometres",
        PBRT.replace("500\n600", "0.5\n0.6"),
        {},
        "found 0.5 to 0.6, expected nm; they look like micro",
    ),
    ("pbrt: metres", PBRT.replace("500\n600", "5e-7\n6e-7"), {}, "expected nm; they look like metres"),
    ("pbrt: same wavelength twice", PBRT.replace("600", "500"), {}, "found 500 nm more than once"),
    ("pbrt: wavelength 0", PBRT.replace("600", "0"), {}, "wavelength: found 0, expected nm above 0"),
    ("pbrt: theta_i above 90", PBRT.replace("1.2 0", "1.7 0"), {}, ":9: theta_i: found 1.7, expected 0 to 1.5708 rad"),
    ("pbrt: negative theta_o", PBRT.replace("0.1 0 0.2", "0.1 0 -0.2"), {}, ":5: theta_o: found -0.2, expected 0 to"),
    (
        "csv: no header",
        CSV.partition("nm\n")[2],
        {"format": "csv"},
        ":1: header: found '0,10,0,0.1,0.2', expected theta",
    ),
    ("csv: only comments", "# quantity: brdf\n", {"format": "csv"}, "found no header"),
    ("csv: semicolons", CSV.replace(",", ";"), {"format": "csv"}, "columns are parted by commas"),
    ("csv: radians in the header", CSV.replace("theta_i_deg", "theta_i_rad"), {}, ":2: header: found 'theta_i_rad,"),
    ("csv: bad wavelength", CSV.replace("600nm", "600"), {}, ":2: header: found column '600', expected a wavelength"),
    ("csv: no wavelength", "theta_i_deg,theta_o_deg,phi_o_deg\n1,2,3\n", {}, "header: found no wavelength"),
    ("csv: a column is missing", CSV + "1,2,3,4\n", {}, ":7: found 4 columns, expected 5, as in the header"),
    ("csv: a column too many", CSV + "1,2,3,4,5,6\n", {}, ":7: found 6 columns, expected 5"),
    ("csv: cut short", CSV[: -len("0,0.7,nan\n")], {}, ":6: found 3 columns, expected 5"),
    ("csv: empty cell", CSV.replace("0.3", ""), {}, ":4: found '', expected a number"),
    ("csv: text", CSV.replace("0.3", "n/a"), {}, ":4: found 'n/a', expected a number"),
    ("csv: fewer rows than stated", "# samples: 5\n" + CSV, {}, ":7: found 4 samples, expected 5, as a comment says"),
    ("csv: bad number of rows", "# samples: many\n" + CSV, {}, ":1: samples: found 'many', expected a whole number"),
    ("csv: three samples", CSV.replace(ROW, ""), {}, "found 3 samples, expected at least 4"),
    ("csv: no row", "\n".join(CSV.split("\n")[:2]) + "\n", {}, "found 0 samples, expected at least 4"),
    ("csv: unknown quantity", CSV.replace("brdf", "btdf"), {}, ":1: quantity: found 'btdf', expected brdf or brdf_cos"),
    (
        "csv: bad azimuth",
        "# mirror_azimuth_deg: 90\n" + CSV,
        {},
        ":1: mirror_azimuth_deg: found '90', expected 180 or 0",
    ),
    ("csv: theta_i above 90", CSV.replace("20,30,180", "95,30,180"), {}, ":5: theta_i: found 95, expected 0 to 90 deg"),
    ("csv: theta_o above 180", CSV.replace("20,30,180", "20,300,180"), {}, ":5: theta_o: found 300, expected 0 to 180"),
    (
        "csv: azimuth far out",
        CSV.replace("20,30,180", "20,30,1e9"),
        {},
        ":5: phi_o: found 1e+09, expected an azimuth in deg",
    ),
    (
        "csv: radians",
        CSV[: CSV.index("0,10")] + "0,0.2,3.1,1,2\n" * 4,
        {},
        "found at most 0.2 and 3.1, expected degrees; the",
    ),
    ("csv: no positive value", CSV[: CSV.index("0,10")] + "0,1,9,0,-1\n" * 4, {}, "no positive value among 8"),
    ("csv: same wavelength twice", CSV.replace("600nm", "500.0nm"), {}, "found 500 nm more than once"),
    ("csv: micrometres", CSV.replace("500nm,600nm", "0.5nm,0.6nm"), {}, "look like micrometres"),
    ("nist: another header", NIST.replace("thetar", "theta_r"), {"format": "nist"}, ":1: header: found 'lambda,thetai"),
    ("nist: no rows", NIST.partition("\n")[0] + "\n", {}, "found no row"),
    ("nist: nanometres", NIST.replace("0.633,", "633,"), {}, ":2: lambda: found 633, expected micrometres"),
    ("nist: rotated sample", NIST.replace(",0,20,", ",5,20,"), {}, ":3: phi: found 5, expected 0"),
    (
        "nist: a direction is missing",
        NIST[: NIST.rindex("0.532")],
        {},
        ":8: lambda 0.532: found 3 directions, expected 4",
    ),
    (
        "nist: another direction",
        NIST[:-40] + NIST[-40:].replace("180", "170"),
        {},
        ":9: lambda 0.532: found another dir",
    ),
    ("nist: a column is missing", NIST.rpartition(",")[0] + "\n", {}, ":9: found 6 columns, expected 7"),
    ("nist: text", NIST.replace("-15,", "x,"), {}, ":3: found 'x', expected a number"),
]


@pytest.mark.parametrize(
    ("content", "changes", "expected"), [case[1:] for case in WRONG_TEXT], ids=[c[0] for c in WRONG_TEXT]
)
def test_wrong_text_is_one_clear_line(tmp_path, content, changes, expected):
    with pytest.raises(UserError) as caught:
        read_text(tmp_path, content, **changes)
    message = str(caught.value)
    assert expected in message and str(tmp_path / "measured.dat") in message and "\n" not in message


def test_missing_file_folder_and_device(tmp_path):
    for path, expected in (
        (tmp_path / "absent.csv", "no such file"),
        (tmp_path, "found a folder"),
        ("/dev/zero", "found a device"),
    ):
        with pytest.raises(UserError, match=expected):
            formats.read(path, options())


# Wrong and hostile HDF5 files

WRONG_HDF5 = [
    ("other schema", {"attributes": {"schema_name": "other"}}, "schema_name: found 'other', expected 'sbrdf-raw'"),
    ("no schema", {"attributes": {"schema_name": None}}, "schema_name: found none, expected 'sbrdf-raw'"),
    ("a result", {"attributes": {"schema_name": "sbrdf-result"}}, "found a result, expected a measurement"),
    ("newer schema", {"attributes": {"schema_version": 2}}, "schema_version: found 2, expected 1 to 1"),
    ("schema version as text", {"attributes": {"schema_version": "one"}}, "schema_version: found 'one'"),
    ("unknown quantity", {"attributes": {"quantity": "btdf"}}, "quantity: found 'btdf', expected brdf or"),
    ("bad azimuth", {"attributes": {"mirror_azimuth_deg": 90}}, "mirror_azimuth_deg: found 90, expected 180 or 0"),
    ("huge attribute", {"attributes": {"quantity": "x" * 20000}}, "quantity: found 'xxx"),
    (
        "array for a word",
        {"attributes": {"quantity": np.zeros(3)}},
        "attribute quantity: found an array or a long text",
    ),
    ("no dataset", {"value": None}, "found no dataset value"),
    ("text", {"theta_o_deg": ["a", "b", "c", "d"]}, "theta_o_deg: found type 'object', expected numbers"),
    ("complex", {"value": np.ones((4, 2)) * 1j}, "value: found type 'complex128', expected numbers"),
    ("transposed", {"value": np.ones((2, 4))}, "value: found shape (2, 4), expected (4, 2)"),
    ("one column", {"value": np.ones(4)}, "value: found shape (4,), expected (4, 2)"),
    ("scalar", {"wavelength_nm": 500.0}, "wavelength_nm: found shape (), expected (1,)"),
    ("shorter angles", {"phi_o_deg": [1.0, 2.0]}, "phi_o_deg: found shape (2,), expected (4,)"),
    (
        "too few",
        {k: [1.0, 2.0] for k in raw_hdf5.ANGLES} | {"value": np.ones((2, 2))},
        "found 2 samples, expected at least 4",
    ),
    ("no wavelength", {"wavelength_nm": np.ones(0), "value": np.ones((4, 0))}, "found no wavelength"),
    ("theta_i above 90", {"theta_i_deg": [0.0, 10, 20, 100]}, "row 3: theta_i: found 100, expected 0 to 90 degrees"),
    ("metres", {"wavelength_nm": [5e-7, 6e-7]}, "look like metres"),
    ("no positive value", {"value": np.full((4, 2), np.nan)}, "no positive value among 8"),
]


@pytest.mark.parametrize(("changes", "expected"), [case[1:] for case in WRONG_HDF5], ids=[c[0] for c in WRONG_HDF5])
def test_wrong_hdf5_is_one_clear_line(tmp_path, changes, expected):
    path = write_raw(tmp_path / "measured.dat", **changes)
    with pytest.raises(UserError) as caught:
        formats.read(path, options())
    message = str(caught.value)
    assert expected in message and str(path) in message and "\n" not in message


def test_hostile_hdf5_is_refused_before_it_is_read(tmp_path):
    def replaced(name, make):
        path = write_raw(tmp_path / name, value=None)
        with h5py.File(path, "a") as file:
            make(file)
        return path

    cyclic = replaced("cyclic", lambda f: f.__setitem__("value", h5py.SoftLink("/value")))
    elsewhere = replaced("external", lambda f: f.__setitem__("value", h5py.ExternalLink("other.h5", "/value")))
    group = replaced("group", lambda f: f.create_group("value"))
    declared = replaced("declared", lambda f: f.create_dataset("value", (10**6, 10**6), "f8", chunks=(10, 10)))
    bomb = replaced(
        "bomb", lambda f: f.create_dataset("value", (4, 2), "f8", maxshape=(None, None), chunks=(2**14, 2**13))
    )
    raw_bytes = replaced("raw", lambda f: f.create_dataset("value", (4, 2), "f8", external=[("/etc/passwd", 0, 64)]))
    layout = h5py.VirtualLayout((4, 2), "f8")
    layout[:] = h5py.VirtualSource("other.h5", "value", (4, 2))
    virtual = replaced("virtual", lambda f: f.create_virtual_dataset("value", layout))
    for path, expected in (
        (cyclic, "found no dataset value|found a link"),
        (elsewhere, "found no dataset value|found a link"),
        (group, "found a link or a group"),
        (declared, r"value: found shape \(1000000, 1000000\), expected at most"),
        (bomb, r"value: found chunks \(16384, 8192\), expected at most"),
        (raw_bytes, "found data of another file"),
        (virtual, "found data of another file"),
    ):
        with pytest.raises(UserError, match=expected):
            formats.read(path, options())


@pytest.mark.parametrize("ending", ["os.kill(os.getpid(), signal.SIGSEGV)", "signal.alarm(1); time.sleep(60)", "1 / 0"])
def test_a_crash_or_hang_of_the_hdf5_library_is_one_line(tmp_path, monkeypatch, ending):
    path = write_raw(tmp_path / "measured.h5")
    assert formats.read(path, options()).num_samples == 4  # the child is up
    script = tmp_path / "worker.py"
    script.write_text(f"import os, signal, sys, time\nsys.stdin.readline()\n{ending}\n")
    isolated._stop_own()
    monkeypatch.setattr(isolated, "WORKER", script)
    for _ in range(2):
        with pytest.raises(UserError, match=r"found damaged HDF5 \(reading it crashes or does not end\)"):
            formats.read(path, options())
    monkeypatch.undo()
    assert formats.read(path, options()).num_samples == 4  # a new child


def test_hdf5_of_no_samples_and_killed_children(tmp_path):
    empty = write_raw(tmp_path / "empty.h5", **{k: np.ones(0) for k in raw_hdf5.ANGLES}, value=np.ones((0, 2)))
    with pytest.raises(UserError, match="found 0 samples"):
        formats.read(empty, options())
    isolated._running_worker().kill()
    with pytest.raises(UserError, match="found 0 samples"):
        formats.read(empty, options())


def test_text_is_bounded(tmp_path, monkeypatch):
    monkeypatch.setattr(text, "MAX_NUMBERS", 20)
    with pytest.raises(UserError, match=":8: found more than 20 numbers"):
        read_text(tmp_path, PBRT)
    monkeypatch.setattr(text, "MAX_LINE_BYTES", 16)
    with pytest.raises(UserError, match=":2: found a line of over 15 bytes"):
        read_text(tmp_path, PBRT)
    monkeypatch.setattr(formats, "MAX_FILE_BYTES", 10)
    with pytest.raises(UserError, match="bytes, expected at most 10"):
        read_text(tmp_path, PBRT)


# Writing


@pytest.mark.parametrize("ending", [".csv", ".h5", ".hdf5"])
@pytest.mark.parametrize("quantity", ["brdf", "relative"])
def test_written_samples_read_back(tmp_path, rng, ending, quantity):
    count = 30
    samples = RawSamples(
        theta_i=rng.uniform(0, np.pi / 2, count),
        theta_o=rng.uniform(0, np.pi / 2, count),
        phi_o=rng.uniform(0, 2 * np.pi, count),
        wavelength_nm=np.array([400.0, 512.25, 700.0]),
        value=rng.lognormal(size=(count, 3)) * 10.0 ** rng.integers(-12, 12, (count, 1)),
        row=np.arange(count),
        quantity=quantity,
        source="a line\nand another",
        source_format="csv",
        source_sha256="",
    )
    samples.value[3, 1] = np.nan
    path = tmp_path / f"samples{ending}"
    formats.write_samples(path, samples)
    found = formats.read(path, options())
    assert found.quantity == quantity
    np.testing.assert_array_equal(found.value, samples.value)
    np.testing.assert_array_equal(found.wavelength_nm, samples.wavelength_nm)
    for name in ("theta_i", "theta_o", "phi_o"):
        np.testing.assert_allclose(getattr(found, name), getattr(samples, name), rtol=0, atol=1e-14)


def test_a_failed_write_leaves_nothing(tmp_path, monkeypatch):
    samples = builtin.measure("amber_glass", count=20)
    broken = dataclasses.replace(samples, value=samples.value[:3])
    old = tmp_path / "old.csv"
    old.write_text("precious")
    with pytest.raises(ValueError):
        formats.write_samples(old, broken)
    assert old.read_text() == "precious"
    with pytest.raises(UserError, match="ending '.dat'"):
        formats.write_samples(tmp_path / "new.dat", samples)
    with pytest.raises(UserError, match="cannot be written"):
        formats.write_samples(old / "below" / "new.csv", samples)
    assert [path.name for path in tmp_path.iterdir()] == ["old.csv"]


# Fuzzing: an answer or one line, whatever the bytes


@pytest.fixture(scope="module")
def seeds(tmp_path_factory):
    folder = tmp_path_factory.mktemp("seeds")
    hdf5 = write_raw(folder / "raw.h5").read_bytes()
    return {"pbrt": PBRT.encode(), "csv": CSV.encode(), "nist": NIST.encode(), "hdf5": hdf5}


def outcome(path, content):
    """Read some bytes; whatever they are, the outcome is samples or one line."""
    path.write_bytes(content)
    try:
        found = formats.read(path, options())
    except UserError as error:
        assert "\n" not in str(error) and len(str(error)) < 600
        return
    assert isinstance(found, RawSamples) and found.num_samples >= table.MIN_SAMPLES


@pytest.mark.parametrize("kind", ["pbrt", "csv", "nist", "hdf5"])
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_files_are_read_or_refused(kind, data, seeds, tmp_path):
    content = bytearray(seeds[kind])
    for _ in range(data.draw(st.integers(0, 4))):
        position = data.draw(st.integers(0, len(content) - 1))
        content[position] ^= 1 << data.draw(st.integers(0, 7))
    if data.draw(st.booleans()):
        del content[data.draw(st.integers(0, len(content))) :]
    outcome(tmp_path / "fuzzed", bytes(content))


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(content=st.binary(max_size=200) | st.text("0123456789.,-+e# \n\tnmtheta_iod", max_size=200).map(str.encode))
def test_any_bytes_are_refused(content, tmp_path):
    outcome(tmp_path / "fuzzed", content)
