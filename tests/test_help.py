"""`--help` and `--help-all` of every command: short enough, complete, and everything they name can be typed."""

from __future__ import annotations

import re
import shlex
from dataclasses import MISSING
from importlib import import_module
from pathlib import Path
from typing import get_args

import pytest
from command_modules import module_of

from endoprior.cli import descriptions, main
from endoprior.cli.arguments import options, parse
from endoprior.cli.prepare import HELP, Prepare
from endoprior.core.checks import InputError

MOST_LINES = 45
VALUES = {
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


class Parsed(BaseException):
    """Stops a command once its arguments are parsed: (args, what `parse` was called with)."""


@pytest.fixture
def parsed(monkeypatch):
    """Runs a command until its arguments are parsed; returns (args, class, page, default)."""

    def stop(cls, argv, command, page, **defaults):
        raise Parsed(parse(cls, argv, command, page, **defaults), cls, page, defaults)

    def run(*words):
        monkeypatch.setattr(f"{module_of(words[0])}.parse", stop)
        with pytest.raises(Parsed) as caught:
            main(list(words))
        return caught.value.args

    for name in descriptions():
        import_module(module_of(name))
    return run


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
def test_help_is_one_page_with_examples_that_parse(command, printed, parsed):
    page = printed(command, "--help")
    assert page == printed(command, "-h") and len(page.splitlines()) <= MOST_LINES
    assert page.startswith(f"usage: endoprior {command}") and page.isascii()
    assert len(examples(page)) >= (2 if "options]" in page and "--" in page else 1)
    for words in examples(page):
        assert words[0] == command
        parsed(*words)


@pytest.mark.parametrize("command", descriptions())
def test_every_option_of_help_all_can_be_typed(command, printed, parsed, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "FILE").write_text("seed: 1")  # --config FILE is read before the options
    page = printed(command, "--help-all")
    args, cls, help_, defaults = parsed(*examples(page)[0])
    arguments = list(options(cls, defaults))
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
    again = parsed(*words)[0]
    assert type(again) is type(args)
    shown = set(re.findall(r"^  (--[\w.-]+)", page, re.MULTILINE))
    assert shown == {each.usual_name for each in named}
    short = printed(command, "--help")
    assert (f"--help-all lists all {len(named)} options." in short) == bool(help_.basics)
    assert help_.basics or short == page


@pytest.mark.parametrize(
    ("command", "usage"),
    [("render", "RUN [OUT] [options]"), ("demo", "[OUT] [options]"), ("train", "DATA [OUT] [options]")],
)
def test_optional_arguments_stand_in_brackets(command, usage, printed):
    assert printed(command, "--help").splitlines()[0] == f"usage: endoprior {command} {usage}"


def test_defaults_are_those_of_the_preset(printed):
    pages = [printed("train", "--preset", name, "--help") for name in ("default", "paper")]
    iterations = [re.search(r"--iterations INT .*\(default: (\d+)\)", page)[1] for page in pages]
    assert iterations == ["1500", "3000"]
    assert "--no-networks" in pages[0] and "Switch off: " in pages[0]


def test_short_names_stand_for_config_fields(parsed):
    config = parsed("train", "a", "b", "--iterations", "7", "--gaussians=300", "--seed", "4")[0].config
    assert (config.schedule.fine_iterations, config.init.budget, config.seed) == (7, 300, 4)
    assert parsed("train", "a", "b", "--init_budget", "9")[0].config.init.budget == 9


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--sed", "1"], "got --sed. Fix: Did you mean --seed? "),
        (["--iteration=5"], "got --iteration. Fix: Did you mean --iterations? "),
        (["--weight"], "got --weight. Fix: Did you mean --temporal.weight? "),
        (["--zzz"], "got --zzz. Fix: `endoprior train --help-all` lists all options."),
        (["--lr", "1"], "got --lr. Fix: `endoprior train --help-all` lists all options."),
        (["c"], "endoprior train: expected DATA OUT, got c."),
        (["--iterations", "x"], "--iterations: invalid int value: 'x'."),
        (["--device=gpu"], "--device: invalid choice: 'gpu' (choose from 'auto', 'cpu', 'cuda')."),
        (["--view", "--view-port", "x"], "--view-port: invalid int value: 'x'."),
        (["--seed"], "--seed: expected one argument."),
        (["--gaussians", "0"], "endoprior: --gaussians: budget must be in [1, 1e+07], got 0. Fix: "),
    ],
)
def test_a_wrong_option_is_named(words, said, capsys):
    assert main(["train", "a", "b", *words]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1 and error.count("Fix: ") == 1


def test_missing_arguments_are_named():
    for words, missing in ((["a"], "OUT"), ([], "VIDEO, OUT")):
        with pytest.raises(InputError, match=rf"^the following arguments are required: {missing}\. Fix: "):
            parse(Prepare, words, "prepare", HELP)
