"""Config: what is right, what is wrong and what the one line says, overrides, autos, the schema."""

import argparse
import dataclasses
import importlib.util
import json
import os
import re

import pytest

from sbrdf_jax.commands import schema as schema_command
from sbrdf_jax.config import (
    NOT_YET,
    check_output,
    config_sha256,
    load_config,
    parse_config,
    resolve,
    resolved_yaml,
)
from sbrdf_jax.errors import UserError
from sbrdf_jax.option_checks import json_schema, option_at
from sbrdf_jax.options import (
    EncodeOptions,
    InputOptions,
    OutputOptions,
    RepresentOptions,
    ResampleOptions,
    RunOptions,
    TargetOptions,
)

GLASS = "input: {path: builtin:amber_glass}\n"
DEFAULTS = RunOptions(input=InputOptions(path="builtin:amber_glass"))

# text after GLASS (line 2 on), where the line must point, what it must say
WRONG_KEYS_AND_VALUES = [
    ("grd: {}", "2:1: grd: unknown key", "did you mean 'grid'?"),
    ("grid:\n  theta_i_stp_deg: 5", "3:3: grid.theta_i_stp_deg: unknown", "did you mean 'theta_i_step_deg'?"),
    ("grid: {theta_i_step_rad: 0.1}", "2:8: grid.theta_i_step_rad: unknown", "'theta_i_step_deg'?"),
    ("smoothness_weight: 1", "2:1: smoothness_weight: unknown", "'resample.smoothness_weight'?"),
    ("qwerty: 1", "2:1: qwerty: unknown key; expected one of input, grid, ", "runtime, output"),
    ("scene: {theta_i_deg: {min: 0, mx: 9}}", "2:31: scene.theta_i_deg.mx: unknown", "'max'?"),
    ("<<: {}", "2:1: <<: unknown key", "expected one of"),
    ("input: {path: x}", "2:1: input: duplicate key", "expected it once"),
    ("grid:\n  reciprocal: false\n  reciprocal: false", "4:3: grid.reciprocal: duplicate", "once"),
    ("grid: {theta_i_step_deg: 7.5 deg}", "2:26: grid.theta_i_step_deg: found '7.5 deg' (text)", "[deg]"),
    ("input2: 1", "2:1: input2: unknown key", "did you mean 'input'?"),
    ("resample: {tolerance: '1e-8'}", "2:23: resample.tolerance: found '1e-8' (text)", "a number above 0"),
    ("output: {path: 5}", "2:16: output.path: found 5; expected text", ""),
    ("output: {report: yes}", "2:18: output.report: found 'yes' (text)", "did you mean true?"),
    ("output: {report: 1}", "2:18: output.report: found 1", "expected true or false"),
    ("grid: {phi_o_step_deg: true}", "2:24: grid.phi_o_step_deg: found true", "a number"),
    ("encode: {coefficients: 20.5}", "2:24: encode.coefficients: found 20.5", "auto or a whole number"),
    ("grid: [1]", "2:7: grid: found a list", "a block with the keys theta_i_step_deg"),
    ("grid:\noutput: {}", "grid: found nothing (null)", "a block with the keys"),
    ("resample: {method: {a: 1}}", "2:20: resample.method: found a block", "one of paper, guided"),
    ("resample: {window: fakctor}", "2:20: resample.window: found 'fakctor'", "did you mean 'factor'?"),
    ("represent: {lobe: Best}", "2:19: represent.lobe: found 'Best'", "did you mean 'best'?"),
    ("represent: {storage: float31}", "2:22: represent.storage: found 'float31'", "did you mean 'float32'?"),
    ("represent: {storage: 8}", "2:22: represent.storage: found 8", "one of float64, float32, float16, quantised"),
    ("grid: {theta_o_step_deg: 91}", "2:26: grid.theta_o_step_deg: found 91", "at most 45 [deg]"),
    ("grid: {theta_o_step_deg: 0}", "2:26: grid.theta_o_step_deg: found 0", "of at least 0.1"),
    ("resample: {tolerance: 1.0}", "2:23: resample.tolerance: found 1.0", "above 0 and below 1"),
    ("resample: {smoothness_weight: -1}", "2:31: resample.smoothness_weight: found -1", "at least 0"),
    ("resample: {smoothness_weight: .nan}", "2:31: resample.smoothness_weight: found nan", "a finite number"),
    ("represent: {target: {ratio: .inf}}", "2:29: represent.target.ratio: found inf", "a finite number"),
    ("scene: {theta_i_deg: [0, 95]}", "2:26: scene.theta_i_deg[1]: found 95", "at most 90 [deg]"),
    ("scene: {theta_i_deg: []}", "2:22: scene.theta_i_deg: found an empty list", "or null"),
    ("scene: {wavelength_nm: {min: 500}}", "2:24: scene.wavelength_nm: found no 'max'", "[nm]"),
    ("grid: {theta_i_step_deg: 7}", "2:26: grid.theta_i_step_deg: found 7", "did you mean 7.5?"),
    ("grid: {phi_o_step_deg: 7}", "2:24: grid.phi_o_step_deg: found 7", "divides 180"),
    ("encode: {basis: fourier, coefficients: 20}", "2:40: encode.coefficients: found 20", "an odd number"),
    ("validate: {folds: 1}", "2:19: validate.folds: found 1", "2 or more"),
    (
        "represent:\n  target: {ratio: 9, error: 0.1}",
        "3:29: represent.target.error: found ratio and error",
        "exactly one",
    ),
    ("represent: {target: {}}", "2:21: represent.target: found none", "exactly one of ratio, numbers, error"),
    ("scene: {wavelength_nm: {min: 600, max: 500}}", "2:40: scene.wavelength_nm.max: found min 600", "min below max"),
    ("grid: [\n  5\n", "4:1: found text that is not YAML", "expected YAML"),
    ("grid:\n\treciprocal: true", "3:1", "not YAML"),
    ("output: {path: \x01}", "2:16", "#x0001"),
    ("---\na: 1", "2:1", "not YAML"),
    ("output: !!python/object:os.system {}", "2:9: output: found the tag", "plain YAML"),
    ("grid: &a {}\nencode: *a", "encode: found an alias", "written out"),
    ("grid: &a {reciprocal: *a}", "grid.reciprocal: found an alias", "written out"),
    ("[a]: 1", "2:1: found a key that is a list", "a word"),
    ('output: {path: "a\\0b"}', "2:16: output.path: found text with a character", "plain text"),
    ("encode: {basis: log_data}\nrepresent: {method: paper}", "2:17: encode.basis", "because method paper"),
    (
        "encode: {basis: log_data}\nrepresent: {method: lobe_harmonics}",
        "encode.basis: found log_data",
        "expected another",
    ),
    ("scene: " + "[" * 25, "2:27: found lists or blocks in each other", "at most 20"),
]

NOT_BUILT = {
    "input.format": ["rgl-bsdf", "merl", "astm", "pab", "inplane", "alta"],
}

WRONG_OVERRIDES = [
    ("grid.theta_i_stp_deg=5", "command line: grid.theta_i_stp_deg=5: unknown key", "'theta_i_step_deg'?"),
    ("gird.phi_o_step_deg=5", "command line: gird.phi_o_step_deg=5: gird: unknown key", "'grid'?"),
    ("grid={phi_step: 5}", "command line: grid={phi_step: 5}: grid.phi_step: unknown", "'phi_o_step_deg'?"),
    ("grid.phi_o_step_deg=400", "command line: grid.phi_o_step_deg=400: found 400", "at most 90 [deg]"),
    ("grid.phi_o_step_deg=7", "command line: grid.phi_o_step_deg=7: found 7", "divides 180"),
    ("output.report=5", "command line: output.report=5: found 5", "true or false"),
    ("grid=[1]", "command line: grid=[1]: found a list", "a block with the keys"),
    ("output.path.x=1", "command line: output.path.x=1: output.path: found a block", "text"),
    ("report", "command line: report: found no =", "key.path=value"),
    ("=5", "command line: =5: found no key", "key.path=value"),
    ("grid..x=5", "command line: grid..x=5: found no key", "key.path=value"),
    ("output.path=", "command line: output.path=: found nothing (null)", "text"),
    ("output.path=[", "command line: output.path=[: found text that is not YAML", "expected YAML"),
    ("grid.x=a\nb", "command line: grid.x=a b: unknown key", ""),
    (
        "represent.method=lobe_harmonic",
        "command line: represent.method=lobe_harmonic: found 'lobe",
        "did you mean 'lobe_harmonics'?",
    ),
    (
        "resample={method: paper, smoothness_weight: data}",
        "command line: resample={method",
        "found data, which method paper",
    ),
    ("resample.smoothness_weight=0", "command line: resample.smoothness_weight=0: found 0", "above 0"),
    (
        "input={path: x, bilateral: false}",
        "command line: input={path: x",
        "bilateral: found false; expected auto or true, because method guided",
    ),
    ("represent.target.numbers=9", "command line: represent.target.numbers=9: found ratio and numbers", "one of"),
]


def error_of(call, *args, **kwargs) -> str:
    """The message of the error, which must be one line."""
    with pytest.raises(UserError) as caught:
        call(*args, **kwargs)
    message = str(caught.value)
    assert "\n" not in message and message.isprintable()
    return message


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty working directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("text, place, said", WRONG_KEYS_AND_VALUES)
def test_wrong_config_is_one_line_with_its_place(text, place, said):
    message = error_of(parse_config, GLASS + text, name="my.yaml")
    assert re.match(r"my\.yaml:\d+:\d+: ", message)
    assert place in message and said in message
    if place[0].isdigit():
        assert message.startswith(f"my.yaml:{place}")


@pytest.mark.parametrize("key, values", NOT_BUILT.items(), ids=NOT_BUILT.keys())
def test_what_is_not_built_is_refused_by_name(key, values):
    *blocks, last = key.split(".")
    for value in values:
        text = "".join(f"{block}:\n  " for block in blocks) + f"{last}: {value}"
        text = f"{text}\n  path: x" if blocks == ["input"] else f"{text}\n{GLASS}"
        message = error_of(parse_config, text, name="my.yaml")
        line, column = (2, len(last) + 5) if blocks else (1, len(last) + 3)
        assert message.startswith(f"my.yaml:{line}:{column}: {key}: found ")
        assert "not available yet" in message and NOT_YET[key][1] in message


def test_every_row_of_not_yet_is_tested():
    assert NOT_BUILT.keys() == NOT_YET.keys()


@pytest.mark.parametrize(
    "content, said",
    [
        (b"", "my.yaml:1:1: found an empty file; expected a config"),
        (b"# nothing\n", "my.yaml:1:1: found an empty file"),
        (b"- 1\n", "my.yaml:1:1: found a list; expected a config"),
        (b"path\n", "my.yaml:1:1: found 'path' (text)"),
        (b"{}\n", "my.yaml:1:1: input.path: found nothing; expected a file, or builtin:amber_glass"),
        (b"grid: {}\ninput: {scale: 2}\n", "my.yaml:2:8: input.path: found nothing"),
        (b"input: {path: ''}\n", "my.yaml:1:15: input.path: found '' (text)"),
        (b"input: x\n", "my.yaml:1:8: input: found 'x' (text); expected a block"),
        (b"a: 1\nb: \xff\n", "my.yaml:2:4: found the byte 0xff, which is not UTF-8"),
        ("input: {path: x}".encode("utf-16"), "my.yaml:1:1: found the byte 0xff"),
        (b"#" * (1 << 16) + b"\n", "my.yaml: found more than 65536 bytes"),
    ],
)
def test_wrong_file(folder, content, said):
    (folder / "my.yaml").write_bytes(content)
    assert error_of(load_config, "my.yaml").startswith(said)


def test_file_that_cannot_be_read(folder):
    assert error_of(load_config, "no.yaml") == "no.yaml: found no such file; expected a YAML config"
    assert error_of(load_config, folder).startswith(f"{folder}: found a folder")
    assert "cannot be read" in error_of(load_config, "a" * 5000)
    (folder / "file").touch()
    assert "cannot be read" in error_of(load_config, "file/my.yaml")


def test_numbers_and_comments_are_those_of_yaml_1_2():
    text = GLASS + "resample: {tolerance: 1e-8, smoothness_weight: 2}  # two\nencode: {coefficients: 0x13}\n"
    options = parse_config(text)
    assert options.resample.tolerance == 1e-8 and isinstance(options.resample.tolerance, float)
    assert options.resample.smoothness_weight == 2.0 and isinstance(options.resample.smoothness_weight, float)
    assert options.encode.coefficients == 19
    assert parse_config(GLASS + "grid: {theta_i_step_deg: 12.857142857142858}").grid.theta_i_step_deg == 90 / 7
    assert parse_config("input: {path: builtin:x, mirror_azimuth_deg: 0}").input.mirror_azimuth_deg == 0
    assert (
        parse_config("input: {path: builtin:x, bilateral: false}\nresample: {method: paper}").input.bilateral is False
    )
    assert parse_config(GLASS + "encode: {basis: cosine, coefficients: 20}").encode.coefficients == 20


def test_a_byte_order_mark_is_skipped(folder):
    (folder / "my.yaml").write_bytes(b"\xef\xbb\xbf" + GLASS.encode())
    assert load_config("my.yaml") == DEFAULTS


def test_full_example_is_the_defaults_with_every_key(request):
    path = request.config.rootpath / "configs" / "full.yaml"
    assert load_config(path) == DEFAULTS
    written = [line.split("#")[0] for line in path.read_text().splitlines()]
    for block in dataclasses.fields(RunOptions):
        start = next(number for number, line in enumerate(written) if line.startswith(f"{block.name}:"))
        if dataclasses.is_dataclass(option_at(DEFAULTS, block.name)):
            keys = vars(option_at(DEFAULTS, block.name))
            shown = [line.strip().split(":")[0] for line in written[start + 1 : start + 1 + len(keys)]]
            assert shown == list(keys)


def test_quickstart_sets_two_keys_only(request):
    options = load_config(request.config.rootpath / "configs" / "quickstart.yaml")
    assert options == DEFAULTS


def test_paths_are_relative_to_the_file_or_to_the_working_directory(folder):
    (folder / "sub").mkdir()
    (folder / "sub" / "my.yaml").write_text("input: {path: ../data/a.csv}\noutput: {path: out/a.h5}\n")
    options = load_config("sub/my.yaml")
    assert options.input.path == str(folder / "data" / "a.csv")
    assert options.output.path == "out/a.h5"
    for override in ("input.path=b.csv", "input={path: b.csv}", f"input.path={folder}/b.csv"):
        assert load_config("sub/my.yaml", [override]).input.path == str(folder / "b.csv")
    assert load_config("sub/my.yaml", ["input.path=builtin:amber_glass"]).input.path == "builtin:amber_glass"
    assert load_config("sub/my.yaml", ["output.path=c.h5"]).output.path == "c.h5"
    options = load_config("sub/my.yaml", ["output.path=~/c.h5", "input.path=~/b.csv"])
    assert (options.input.path, options.output.path) == (os.path.expanduser("~/b.csv"), os.path.expanduser("~/c.h5"))


@pytest.mark.parametrize("override, place, said", WRONG_OVERRIDES)
def test_wrong_override_names_the_command_line(override, place, said):
    text = GLASS + "grid: {phi_o_step_deg: 5}\nrepresent: {target: {ratio: 9}}\n"
    message = error_of(parse_config, text, [override])
    assert message.startswith(place) and said in message


def test_overrides_are_yaml_in_order_and_a_mapping_replaces_the_block():
    text = GLASS + "grid: {theta_i_step_deg: 15, phi_o_step_deg: 5}\nrepresent: {target: {ratio: 9}}\n"
    options = parse_config(text, ["resample.tolerance=1e-6", "grid.theta_i_step_deg=10", "grid.theta_i_step_deg=9"])
    assert options.resample.tolerance == 1e-6
    assert (options.grid.theta_i_step_deg, options.grid.phi_o_step_deg) == (9.0, 5.0)
    assert parse_config(text, ["grid={theta_o_step_deg: 5}"]).grid == dataclasses.replace(
        DEFAULTS.grid, theta_o_step_deg=5.0
    )
    assert parse_config(text, ["grid={}"]).grid == DEFAULTS.grid
    assert parse_config(text, ["represent.target={numbers: 513}"]).represent.target == TargetOptions(numbers=513)
    assert parse_config(text, ["output.path='a=b.h5'"]).output.path == "a=b.h5"
    assert parse_config("grid: {}", ["input.path=builtin:amber_glass"]) == DEFAULTS
    assert parse_config(text, ["input={path: builtin:amber_glass, scale: 2}"]).input.scale == 2.0


def test_a_wrong_file_is_not_mended_by_an_override():
    message = error_of(parse_config, GLASS + "grid: 5", ["grid.theta_i_step_deg=5"], name="my.yaml")
    assert message.startswith("my.yaml:2:7: grid: found 5")


def test_a_clash_of_file_and_override_names_what_was_written_last():
    text = GLASS + "scene: {wavelength_nm: {min: 500, max: 600}}"
    message = error_of(parse_config, text, ["scene.wavelength_nm.min=700"], name="my.yaml")
    assert message.startswith("command line: scene.wavelength_nm.min=700: found min 700 and max 600")
    message = error_of(parse_config, GLASS + "scene: {theta_i_deg: [0, 45]}", ["scene.theta_i_deg.min=7"])
    assert message.startswith("command line: scene.theta_i_deg.min=7: ") and "found no 'max'" in message


def test_autos_of_the_defaults_and_of_paper():
    assert resolve(DEFAULTS).resample == ResampleOptions(method="guided", smoothness_weight="data", tolerance=1e-6)
    paper = RepresentOptions(method="paper")
    options = resolve(dataclasses.replace(DEFAULTS, resample=ResampleOptions(method="paper"), represent=paper))
    assert options.resample == ResampleOptions(method="paper", smoothness_weight=1.0, tolerance=1e-8)
    assert options.encode == EncodeOptions(basis="fourier", coefficients=19)
    assert (options.represent.method, options.represent.max_degree) == ("paper", 4)
    assert options.input.bilateral == options.input.quantity == "auto"  # for the data to decide
    assert resolve(options) == options


def test_autos_of_other_methods_and_given_values():
    options = dataclasses.replace(
        DEFAULTS,
        resample=ResampleOptions(method="guided"),
        represent=RepresentOptions(method="lobe_tensor"),
    )
    found = resolve(options)
    assert (found.resample.smoothness_weight, found.resample.tolerance) == ("data", 1e-6)
    assert (found.encode, found.represent.max_degree) == (EncodeOptions(basis="data", coefficients=12), 8)
    assert resolve(DEFAULTS).represent.method == "auto"  # for the data to decide
    options = parse_config(GLASS + "represent: {max_degree: 1}\nresample: {tolerance: 1e-4}\nencode: {basis: cosine}")
    found = resolve(options)
    assert (found.represent.max_degree, found.resample.tolerance) == (1, 1e-4)
    assert found.encode == EncodeOptions(basis="cosine", coefficients=19)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "represent: {target: {error: 0.045}, lobe: tan}",
        "resample: {method: paper, tolerance: 1e-12, smoothness_weight: 0}\noutput: {path: 'a: #b, 1e-8.h5'}",
        "grid: {theta_i_step_deg: 12.857142857142858}\nencode: {basis: identity}",
        f"output: {{path: {'long name/' * 40}x.h5}}",
    ],
)
def test_resolved_yaml_comes_back_equal(text):
    for options in (parse_config(GLASS + text), resolve(parse_config(GLASS + text))):
        written = resolved_yaml(options)
        assert parse_config(written) == options
        assert resolved_yaml(parse_config(written)) == written
        assert re.fullmatch("[0-9a-f]{64}", config_sha256(options))


def test_resolved_yaml_has_every_key_and_its_hash_sees_each():
    data = resolved_yaml(DEFAULTS)
    for block in dataclasses.fields(RunOptions):
        assert f"{block.name}:" in data
        for key in vars(option_at(DEFAULTS, block.name)) if block.name != "scene" else ():
            assert f"  {key}:" in data
    assert config_sha256(DEFAULTS) == config_sha256(parse_config(GLASS))
    assert config_sha256(DEFAULTS) != config_sha256(parse_config(GLASS, ["resample.tolerance=1e-7"]))


def test_an_input_path_comes_back_from_another_folder(folder):
    (folder / "my.yaml").write_text("input: {path: a.csv}\n")
    options = load_config("my.yaml")
    assert parse_config(resolved_yaml(options), folder="/elsewhere") == options


def with_output(path, **kwargs) -> RunOptions:
    return dataclasses.replace(DEFAULTS, output=OutputOptions(path=str(path), **kwargs))


def test_output_that_can_be_written_leaves_nothing(folder):
    check_output(with_output("a/b/c.h5"))
    check_output(with_output(folder / "c.h5"))
    assert list(folder.iterdir()) == []
    (folder / "old.h5").touch()
    check_output(with_output("old.h5", overwrite=True))


def test_output_that_cannot_be_written(folder):
    (folder / "old.h5").touch()
    (folder / "sub").mkdir()
    assert "which exists; expected a new file, or output.overwrite=true" in error_of(
        check_output, with_output("old.h5")
    )
    for overwrite in (False, True):
        assert "a folder; expected the name of a file" in error_of(
            check_output, with_output("sub", overwrite=overwrite)
        )
    assert "a folder" in error_of(check_output, with_output("new/"))
    assert "'" + str(folder / "old.h5") + "' is a file" in error_of(check_output, with_output("old.h5/a/b.h5"))
    assert "no regular file" in error_of(check_output, with_output("/dev/null", overwrite=True))
    assert "cannot be used" in error_of(check_output, with_output("a" * 5000))
    options = dataclasses.replace(
        with_output("old.h5", overwrite=True), input=InputOptions(path=str(folder / "old.h5"))
    )
    assert "the input itself" in error_of(check_output, options)


def test_output_in_a_folder_that_is_read_only(folder, monkeypatch):
    # the tests may run as root, who may write everywhere: so what the system answers is given here
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    assert f"the folder '{folder}' cannot be written" in error_of(check_output, with_output("a/b.h5"))


def test_schema_has_every_key_with_type_default_and_description(capsys):
    assert schema_command.run(argparse.Namespace()) == 0
    schema = json.loads(capsys.readouterr().out)
    assert schema == json_schema()
    assert schema["$schema"] == "https://json-schema.org/draft/2020-12/schema"
    assert schema["required"] == ["input"]

    def check(block, record):
        assert block["additionalProperties"] is False
        assert list(block["properties"]) == [field.name for field in dataclasses.fields(record)]
        for name, key in block["properties"].items():
            referred = schema["$defs"].get(key.get("$ref", "").removeprefix("#/$defs/"), {})
            assert key.get("description") or referred["description"]
            assert "default" in key or name in block["required"]
            inner = getattr(record, name, None)
            if referred:
                check(referred, inner)

    check(schema, DEFAULTS)
    blocks = schema["$defs"]
    assert blocks["GridOptions"]["properties"]["phi_o_step_deg"]["maximum"] == 90
    assert blocks["ResampleOptions"]["properties"]["window"]["enum"] == ["none", "product", "factor"]
    assert blocks["RepresentOptions"]["properties"]["target"]["default"] == {"ratio": 125.0}
    assert schema["properties"]["represent"]["default"]["target"] == {"ratio": 125.0}
    assert blocks["TargetOptions"]["minProperties"] == blocks["TargetOptions"]["maxProperties"] == 1


@pytest.mark.skipif(importlib.util.find_spec("jsonschema") is None, reason="jsonschema is not installed")
def test_configs_validate_against_the_schema():
    import jsonschema
    from ruamel.yaml import YAML

    validator = jsonschema.Draft202012Validator(json_schema())
    validator.check_schema(json_schema())
    yaml = YAML(typ="safe", pure=True)
    validator.validate(yaml.load(resolved_yaml(DEFAULTS)))
    for text in ("grd: {}", "grid: {theta_i_step_deg: 91}", "represent: {target: {ratio: 9, error: 0.1}}", "grid: 5"):
        assert not validator.is_valid(yaml.load(GLASS + text))
