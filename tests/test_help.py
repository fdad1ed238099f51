"""`--help` and `--help-all` of every command: short enough, complete, and everything they name can be typed."""

from __future__ import annotations

import re
import shlex
from dataclasses import MISSING
from pathlib import Path
from typing import get_args

import pytest
from command_modules import parsed

from endoprior.cli import descriptions, main
from endoprior.cli.arguments import options
from endoprior.cli.train import Train
from endoprior.core.checks import InputError
from endoprior.core.config import DataConfig
from endoprior.data import load_sequence
from endoprior.model.presets import preset, preset_names

MAX_LINES = {"train": 62}  # it lists the presets
VALUES = {
    "--events": "blur:1-2",
    int: 1,
    float: 300,
    Path: "x",
    str: "x",
    "--config": "FILE",
    "--times": 0.5,
    "--data.skip-frames": "0-9",
    "--data.window": "0-9",
}
"""Values of options without a default, by name or type."""


@pytest.fixture
def printed(monkeypatch, capsys):
    """The page that a command prints."""

    def show(*words):
        monkeypatch.setenv("COLUMNS", "80")
        with pytest.raises(SystemExit) as left:
            main(list(words))
        assert left.value.code == 0
        return capsys.readouterr().out

    return show


def examples(page: str) -> list[list[str]]:
    """Words of the example commands."""
    return [shlex.split(line)[1:] for line in page.partition("examples:\n")[2].splitlines() if line.startswith("  ")]


@pytest.mark.parametrize("command", descriptions())
def test_help_is_one_page_with_examples_that_parse(command, printed):
    page = printed(command, "--help")
    assert page == printed(command, "-h") and len(page.splitlines()) <= MAX_LINES.get(command, 45)
    assert page.startswith(f"usage: endoprior {command}") and page.isascii()
    assert len(examples(page)) >= (2 if "options]" in page and "--" in page else 1)
    for words in examples(page):
        assert words[0] == command and parsed(*words)


@pytest.mark.parametrize("command", descriptions())
def test_every_option_of_help_all_can_be_typed(command, printed):
    page = printed(command, "--help-all")
    args = parsed(*examples(page)[0])
    arguments = list(options(type(args), {"config": preset()} if command == "train" else {}))
    words, named = [command], [each for each in arguments if not each.is_positional]
    for each in arguments:
        words += [] if each.is_positional else [each.usual_name]
        value = each.default
        if value in (None, "", (), MISSING) or each.is_positional:
            kinds = [kind for kind in (each.kind, *get_args(each.kind)) if kind in VALUES or isinstance(kind, str)]
            value = VALUES.get(each.name) or VALUES.get(kinds[0], kinds[0])
        if each.kind is not bool:
            words += map(str, value) if isinstance(value, tuple) else [str(value)]
        assert re.search(rf"^  {re.escape(each.usual_name)}\b", page, re.MULTILINE), each.name
    assert type(parsed(*words)) is type(args)
    assert set(re.findall(r"^  (--[\w.-]+)", page, re.MULTILINE)) == {each.usual_name for each in named}
    short = printed(command, "--help")
    assert short == page or short.endswith(f"--help-all lists all {len(named)} options.\n")


@pytest.mark.parametrize(
    ("command", "usage"),
    [("render", "RUN [OUT] [options]"), ("demo", "[OUT] [options]"), ("train", "DATA [OUT] [options]")],
)
def test_optional_arguments_stand_in_brackets(command, usage, printed):
    assert printed(command, "--help").splitlines()[0] == f"usage: endoprior {command} {usage}"


def test_defaults_are_those_of_the_preset(printed):
    pages = [printed("train", "--preset", name, "--help") for name in ("default", "paper")]
    iterations = [re.search(r"--iterations INT .*\(default: (\d+)\)", page)[1] for page in pages]
    assert iterations == ["1350", "4000"]
    assert "--no-networks" in pages[0] and "Switch off: " in pages[0]


def test_short_names_and_the_length_change_the_config():
    config = Train.from_words(["a", "b", "--iterations", "7", "--gaussians=300", "--seed", "4"]).config
    assert (config.schedule.fine_iterations, config.init.budget, config.seed) == (7, 300, 4)
    assert parsed("train", "a", "b", "--init_budget", "9").config.init.budget == 9


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--sed", "1"], "endoprior train: unrecognized arguments: --sed 1. Fix: `endoprior train --help-all` lists"),
        (["--iteration=5"], "unrecognized arguments: --iteration=5"),
        (["c"], "unrecognized arguments: c."),
        (["--iterations", "x"], "--iterations: invalid int value: 'x'."),
        (["--device=gpu"], "--device: invalid choice: 'gpu' (choose from "),
        (["--view", "--view-port", "x"], "--view-port: invalid int value: 'x'."),
        (["--seed"], "--seed: expected one argument."),
        (["--weights-dir", ""], "endoprior train: expected no empty argument, got one."),
        (["--gaussians", "0"], "endoprior: --gaussians: budget must be in [1, 1e+07], got 0. Fix: "),
    ],
)
def test_a_wrong_option_is_named(words, said, capsys):
    assert main(["train", "a", "b", *words]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1 and error.count("Fix: ") == 1


@pytest.mark.parametrize("words", [("train", "a", "b"), ("run", "a", "b"), ("demo", "b")])
def test_a_mistyped_choice_is_corrected(words, capsys):
    assert main([*words, "--preset", "papr"]) == 2
    assert capsys.readouterr().err.endswith("'surgicalgaussian'). Fix: `--preset paper`.\n")
    assert main([*words, "--preset", "nothing like it"]) == 2
    elsewhere = "`endoprior plugins` lists the presets of other packages"
    assert capsys.readouterr().err.endswith(f"Fix: `endoprior {words[0]} --help-all` lists all options; {elsewhere}.\n")


@pytest.mark.parametrize(("words", "missing"), [(["a"], "OUT"), ([], "VIDEO, OUT")])
def test_missing_arguments_are_named(words, missing):
    with pytest.raises(InputError, match=rf"the following arguments are required: {missing}\. Fix: "):
        parsed("prepare", *words)


def test_every_preset_has_a_line(printed):
    page = printed("train", "--help")
    for name in preset_names():
        line = next(line for line in page.splitlines() if line.startswith(f"  {name} "))
        assert 25 < len(line) <= 80, line


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        (["trian"], "endoprior train"),
        (["PREPARE", "a", "b"], "endoprior prepare"),
        (["run", "a", "b", "--preveiw"], "--preview"),
        (["run", "a", "--preveiw"], "--preview"),
        (["run", "a", "b", "--all-segment"], "--all-segments"),
        (["train", "a", "b", "--iteratons", "5"], "--iterations"),
        (["train", "a", "b", "--budget=5"], "--init.budget"),
        (["prepare", "a", "b", "-calibration", "c"], "--calibration"),
        (["bench", "quick", "a", "--metods", "paper"], "--methods"),
        (["bench", "quik", "a"], "quick"),
        (["bench", "quick", "a", "--methods", "papr"], "paper"),
        (["eval", "a", "--protocol", "endonref"], "endonerf"),
    ],
)
def test_a_mistyped_name_is_corrected(words, meant, capsys):
    assert main(words) == 2
    error = capsys.readouterr().err
    assert error.endswith(f". Did you mean `{meant}`?\n") and error.count("\n") == error.count("Fix: ") == 1


def test_a_mistyped_preset_or_format_is_corrected_in_python():
    with pytest.raises(InputError, match=r"got 'defualt'\. Fix: Choose one of them\. Did you mean `default`\?$"):
        preset("defualt")
    with pytest.raises(InputError, match=r"Fix: See docs/datasets\.md\. Did you mean `nerfstudio`\?$"):
        load_sequence("src", DataConfig(format="nerf_studio"))


def test_a_name_unlike_any_other_is_not_corrected(capsys):
    for words in (["zzz"], ["run", "a", "b", "--zzz"], ["run", "a", "b", "c"]):
        assert main(words) == 2
        assert "Did you mean" not in capsys.readouterr().err
