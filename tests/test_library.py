"""The library file: the example, the ways to list materials, overrides, and the one line where it is wrong."""

import pytest
from conftest import ROOT
from quick_library import write_library

from sbrdf_jax.batch.library import load_library, take_shard
from sbrdf_jax.config import load_config, resolve
from sbrdf_jax.errors import UserError

HEAD = "base: base.yaml\noutput_folder: out\n"
ONE = "- {name: a, input: raw/a.txt}"

# text after HEAD (line 3 on), where the line must point, what it must say
WRONG = [
    ("materials: []", "3:12: materials: found an empty list", "a list, each a block with the keys name, input"),
    ("materials: 5", "3:12: materials: found 5", "a list, each"),
    ("matrials: x", "3:1: matrials: unknown key", "did you mean 'materials'?"),
    ("materials:\n- {name: a}", "4:3: materials[0]: found no 'input'", "expected text"),
    ("materials:\n- {name: a, inpt: b}", "4:13: materials[0].inpt: unknown key", "did you mean 'input'?"),
    ("materials:\n- {name: 5, input: b}", "4:10: materials[0].name: found 5", "text"),
    ("materials:\n- {name: a/b, input: b}", "4:10: materials[0].name: found the name 'a/b'", "letters, digits"),
    ("materials:\n- {name: index, input: b}", "4:10: materials[0].name: found the name 'index'", "not 'index'"),
    (f"materials:\n{ONE}\n{ONE}", "5:10: materials[1].name: found the name 'a' again", "library.yaml:4:10"),
    (f"materials:\n{ONE}\n- {{name: A, input: b}}", "5:10: materials[1].name: found the name 'A' again", "once"),
    (
        "materials:\n- {name: a, input: b, overrides: {grid.theta_o_stp_deg: 5}}",
        "4:35: materials[0].overrides.grid.theta_o_stp_deg: unknown key",
        "did you mean 'theta_o_step_deg'?",
    ),
    (
        "materials:\n- {name: a, input: b, overrides: {grid: {theta_o_step_deg: 400}}}",
        "4:35: materials[0].overrides.grid: grid.theta_o_step_deg: found 400",
        "at most 45 [deg]",
    ),
    (
        "materials:\n- {name: a, input: b, overrides: {output.path: x}}",
        "4:35: materials[0].overrides.output.path: found output.path",
        "output_folder",
    ),
    (
        "materials:\n- {name: a, input: b, overrides: {input: {path: x}}}",
        "4:35: materials[0].overrides.input: found input.path",
        "each material's input",
    ),
    ("materials:\n- {name: a, input: b, overrides: [1]}", "4:34: materials[0].overrides: found a list", "a block"),
    ("materials: no/*.csv", "3:12: materials: found no file that 'no/*.csv' fits", "relative to"),
    ("materials: none.csv", "none.csv: cannot be read (No such file", "a CSV table"),
    ("materials: bad.csv", "bad.csv:1: found 'theta_i,x'", "name,input"),
    ("materials: short.csv", "short.csv:3: found 2 cells", "expected 3"),
    ("materials: empty.csv", "empty.csv: found no row", "materials"),
    ("materials: typo.csv", "typo.csv:2: grid.theta_o_stp_deg: unknown key", "'theta_o_step_deg'?"),
    (
        "materials: raw/*.txt\nexecutor: {kind: cloud}",
        "4:18: executor.kind: found 'cloud'",
        "one of local, slurm, dask",
    ),
    ("materials: raw/*.txt\nexecutor: {workers: 0}", "4:21: executor.workers: found 0", "of at least 1"),
    ("materials: raw/*.txt\nexecutor: {slurm: {shards: x}}", "executor.slurm.shards: found 'x'", "a whole number"),
    ("materials: raw/*.txt\nbase: other.yaml", "4:1: base: duplicate key", "once"),
]
TABLES = {
    "bad.csv": "theta_i,x\n",
    "short.csv": "name,input,grid.reciprocal\na,raw/a.txt,\nb,raw/b.txt\n",
    "empty.csv": "name,input\n",
    "typo.csv": "name,input,grid.theta_o_stp_deg\na,raw/a.txt,5\n",
    "good.csv": "name,input,represent.max_degree,validate.fold_file\n"
    "a,raw/b.txt,2,\nc,builtin:amber_glass,,folds.csv\n",
}


@pytest.fixture
def folder(tmp_path):
    """A folder with two measurements, a base config and tables."""
    write_library(tmp_path, {"a": "ok", "b": "ok"})
    for name, text in TABLES.items():
        (tmp_path / name).write_text(text)
    return tmp_path


@pytest.mark.parametrize(("text", "place", "said"), WRONG)
def test_wrong_library_is_one_line(text, place, said, folder, monkeypatch):
    monkeypatch.chdir(folder)
    (folder / "library.yaml").write_text(HEAD + text)
    with pytest.raises(UserError) as error:
        load_library("library.yaml")
    message = str(error.value)
    assert place in message and said in message and "\n" not in message


def test_the_example_holds_every_default():
    library = load_library(ROOT / "configs" / "library.yaml")
    assert [material.name for material in library.materials] == [
        "amber_glass",
        "amber_glass_sharp",
        "amber_glass_broad",
    ]
    assert library.executor == type(library.executor)()
    assert str(library.folder) == "results/library"
    assert {material.options.represent.target.numbers for material in library.materials} == {None, 300}
    assert not library.materials[0].options.output.report


def test_a_material_is_what_run_would_compute(folder, monkeypatch):
    monkeypatch.chdir(folder)
    library = load_library("library.yaml", ["represent={max_degree: 2}", "executor.workers=3", "output_folder=res"])
    assert library.executor.workers == 3
    base = str(folder / "base.yaml")
    wanted = [f"input.path={folder}/raw/a.txt", "represent={max_degree: 2}", "output.path=res/a.h5"]
    assert library.materials[0].options == resolve(load_config(base, wanted))


def test_a_table_sets_keys_by_columns(folder):
    lines = (folder / "library.yaml").read_text().replace("raw/*.txt", "good.csv")
    (folder / "library.yaml").write_text(lines)
    first, second = load_library(folder / "library.yaml").materials
    assert (first.name, first.options.input.path) == ("a", str(folder / "raw" / "b.txt"))
    assert first.options.represent.max_degree == 2 and second.options.represent.max_degree == 8
    assert second.options.input.path == "builtin:amber_glass"
    assert second.options.validate.fold_file == str(folder / "folds.csv")


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("output.path=x", "command line: output.path=x: found output.path"),
        ("materals=x", "command line: materals=x: unknown key"),
        ("executor.worker=3", "command line: executor.worker=3: unknown key; expected one of kind, workers"),
        ("represent.max_degree=-1", "command line: represent.max_degree=-1: found -1"),
    ],
)
def test_wrong_override_is_one_line(override, said, folder):
    with pytest.raises(UserError) as error:
        load_library(folder / "library.yaml", [override])
    assert said in str(error.value)


def test_shards_are_all_and_nearly_equal(folder):
    materials = load_library(ROOT / "configs" / "library.yaml").materials * 7
    parts = [take_shard(materials, number, 4) for number in range(1, 5)]
    assert sum(parts, ()) == materials
    assert {len(part) for part in parts} == {5, 6}
