"""The options of `mi-ring fit` in their groups, and the settings that a results folder says."""

import dataclasses
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest

from mi_ring import export, fit
from mi_ring.errors import InputError
from mi_ring.fit_config import FitConfig, Task, parse_options
from mi_ring.fitting.config import PRESETS, TASK, WEIGHTS, Ablation, Common, Config, Tuning


def names(*kinds):
    return {f.name.replace("_", "-") for kind in kinds for f in dataclasses.fields(kind)} - {"scene", "weights"}


def help_by(argument, capsys):
    """The help: the options of each box by its title, and its last line. Boxes have no sides where not UTF-8 is."""
    with pytest.raises(SystemExit) as stop:
        parse_options(["scene.xml", "--levels", "4", argument])
    assert not stop.value.code
    text = capsys.readouterr().out
    _, *box = re.split(r"^(?:╭─)? ((?:\w+ )?options|positional arguments) +(?:─*╮)?$", text, flags=re.M)
    options = [set(re.findall(r"^[│ ] --([a-z][a-z.-]+)", rows, re.M)) for rows in box[1::2]]
    return dict(zip(box[::2], options)), text.strip().splitlines()[-1]


def test_help_shows_what_users_set_and_says_how_many_more_options_there_are(capsys):
    found, below = help_by("--help", capsys)
    assert found["options"] == names(Task, Common) and len(found["options"]) == 16
    assert set(found) <= {"positional arguments", "options"}
    everything, other = help_by("--help-all", capsys)
    assert everything["options"] == found["options"]
    assert everything["tuning options"] == names(Tuning) and everything["ablation options"] == names(Ablation)
    assert everything["weights options"] == {f"weights.{name.replace('_', '-')}" for name in WEIGHTS}
    hidden = sum(map(len, everything.values())) - len(found["options"])
    assert below == f"{hidden} more options, for tuning and ablation: --help-all shows them" != other


@pytest.mark.parametrize("arguments", [["--help-all"], ["run", "--help-all"], ["--help"]])
def test_commands_without_hidden_options_have_both_helps(arguments, capsys):
    with pytest.raises(SystemExit) as stop:
        export.main(arguments)
    assert not stop.value.code and "--subdivisions" in capsys.readouterr().out


def test_hidden_options_are_options_all_the_same():
    words = "--levels 3 --widths 64 --shares 1 --weights.mask 2 --no-shadows --optimizer adam --spp=2 --holdout 8"
    config = parse_options(["scene.xml", *words.split()])
    assert config == FitConfig(scene=Path("scene.xml"), levels=(3,), widths=(64,), shares=(1.0,), spp=2, holdout=8,
                               weights={"mask": 2.0}, shadows=False, optimizer="adam")  # fmt: skip
    assert names(Config) == names(Common, Tuning, Ablation) and names(FitConfig) == names(Task, Config)
    assert {f.name for f in dataclasses.fields(Task)} == TASK


@pytest.mark.parametrize("preset", PRESETS)
def test_settings_are_read_from_the_results(preset, tmp_path):
    config = parse_options(["scene.xml", "--preset", preset, "--minutes", "3"])
    options = json.dumps(dataclasses.asdict(config), default=str)  # as the command writes them
    (tmp_path / "config.json").write_text(options)
    assert Config.load(tmp_path) == Config.load(f"{tmp_path}/config.json") == Config.preset(preset)


def test_settings_of_all_kinds_are_read_as_they_were(tmp_path):
    config = Config(domain=("mesh", Path("a.ply")), refine=("cameras", "light"), weights={"mine": 2.0}, levels=(3,),
                    widths=(64,), shares=(1,), parameters={"haze": (0.0, math.inf)}, deterministic=True)  # fmt: skip
    (tmp_path / "config.json").write_text(json.dumps(config.settings()))
    assert Config.load(tmp_path) == config
    (tmp_path / "config.json").write_text('{"iterations": 7, "scene": "a.xml"}')
    assert Config.load(tmp_path) == Config(iterations=7)


@pytest.mark.parametrize(("content", "words"), [
    (None, "cannot be read (No such file or directory); give the results folder of a fit"),
    ("{", "is not JSON"),
    ("[1]", "holds no settings"),
    ('{"solver": "euler"}', "solver: is no setting of mi_ring"),
    ('{"iterations": "many"}', "--iterations: is many, must be as mi-ring fit --help-all says"),
    ('{"blur": 0.06}', "blur: is no setting of mi_ring"),
    ('{"levels": [4, 5.5, 6]}', "--levels: is 4 5.5 6"),
    ('{"parameters": {"haze": [0]}}', "--parameters: is haze 0"),
    ('{"domain": ["mesh"]}', "--domain: is mesh, must be auto, sphere, hull or (mesh, FILE)"),
    ('{"loss": "l3"}', "--loss: is l3, must be one of l2"),
    ('{"refine": ["gian"]}', "--refine: is gian, must be a list of names: auto, none"),
    ('{"learning_rate": -1}', "--learning-rate: is -1.0, must be above 0"),
    ('{"levels": [4]}', "--widths: is 128 256 512, must be as many values as --levels (1)"),
])  # fmt: skip
def test_settings_that_cannot_be_are_one_line(content, words, tmp_path):
    file = tmp_path / "config.json"
    if content:
        file.write_text(content)
    with pytest.raises(InputError) as error:
        Config.load(file)
    assert str(error.value).startswith(f"{file}: {words}") and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--preset", "quick"], ["--preset: is quick; must be one of fast"]),
        (["--preset"], ["--preset: has no value"]),
        (["--weights.mask", "-5"], ["--weights", "0 or more"]),
        (["--seed", str(2**70)], ["--seed", "below 2^63"]),
        (["--iterations", "many"], ["--iterations: is many; must be a whole number"]),
        (["--iterations", "0"], ["--iterations", "0", "1 to 1,000,000"]),
        (["--steps", "0"], ["--steps: is 0, must be 1 to 10,000"]),
        (["--iterations", "9" * 20], ["--iterations: is 99999999999999999999, must be 1 to 1,000,000"]),
        (["--levels", "4", "5", "--widths", "9", "9", "--shares", "1e308", "1e308"], ["--shares: is 1e+308 1e+308"]),
        (["--velocity-decay", "0"], ["--velocity-decay", "0", "above 0"]),
        (["--iteration", "5"], ["Unrecognized options: --iteration", "--iterations"]),
        (["--levels", "4", "9"], ["--levels", "0 to 8"]),
        (["--levels", "4"], ["--widths", "as many"]),
        (["--loss", "l3"], ["--loss: is l3; must be one of", "log"]),
        (["--domain", "cube"], ["--domain: is cube; must be auto|sphere|hull|mesh PATH"]),
        (["--domain", "mesh"], ["--domain: is mesh; must be"]),
        (["--learning-rate", "-1"], ["--learning-rate", "above 0"]),
        (["--learning-rate", "fast"], ["--learning-rate: is fast; must be a number"]),
        (["--widths", "128", "wide"], ["--widths: is 128 wide, must be INT [INT ...]"]),
        (["--widths"], ["--widths: is empty, must be as many values as --levels (3)"]),
        (["--parameters", "principled"], ["--parameters: must be STR FLOAT FLOAT [STR FLOAT FLOAT ...]"]),
        (["--refine", "gian"], ["--refine: is gian; must be one of auto, none", "; perhaps you meant gain"]),
        (["--refine", "power", "gain"], ["--refine: is power gain, must be without power or without gain"]),
    ],
)
def test_an_unusable_option_is_one_line_that_names_it(options, words):
    with pytest.raises(InputError) as error:
        fit.parse_options(["scene.xml", *options])
    complaint = str(error.value)
    assert complaint.startswith(words[0]) and "\n" not in complaint and all(word in complaint for word in words)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"iterations": "many"}, "--iterations: is many, must be as mi-ring fit --help-all says"),
        ({"iterations": 3.5}, "--iterations: is 3.5"),
        ({"iterations": True}, "--iterations: is True"),
        ({"levels": 3}, "--levels: is 3"),
        ({"weights": {"rgb": None}}, "--weights: is rgb None"),
        ({"parameters": {"roughness": 1}}, "--parameters: is roughness 1"),
        ({"seed": None}, "--seed: is None"),
        ({"shadows": "no"}, "--shadows: is no"),
        ({"domain": ("mesh", 3)}, "--domain: is mesh 3"),
        ({"learning_rate": 10**400}, "--learning-rate: is 1000"),
        ({"loss": ["l1"]}, "--loss: is l1, must be one of l2"),
        ({"refine": "cameras"}, "--refine: is cameras, must be a list of names"),
        ({"refine": 3}, "--refine: is 3"),
        ({"refine": [["cameras"]]}, "--refine: is cameras"),
        ({"refine": ()}, "--refine: is empty"),
    ],
)
def test_settings_of_another_type_are_refused(settings, words):
    with pytest.raises(InputError, match=words):
        Config(**settings)


def test_numbers_of_numpy_are_settings_that_can_be_written():
    config = Config(iterations=np.int64(5), learning_rate=np.float32(0.5), levels=np.array([2]).tolist(), widths=[28],
                    shares=(np.float64(1),), shadows=np.bool_(False))  # fmt: skip
    same = {"iterations": 5, "learning_rate": 0.5, "levels": [2], "widths": [28], "shares": [1], "shadows": False}
    assert config.settings() == Config().settings() | same
