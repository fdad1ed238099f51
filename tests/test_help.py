"""`--help` and `--help-all` of every command: short enough, complete, and everything they name can be typed."""

from __future__ import annotations

import re
import shlex
from importlib import import_module

import pytest
from command_modules import module_of

from endoprior.cli import descriptions, main
from endoprior.cli.options import options
from endoprior.cli.parsing import parse
from endoprior.core.checks import InputError

MOST_LINES = 45
VALUES = {
    "INT": "1",
    "FLOAT": "300",
    "PATH": "x",
    "STR": "x",
    "FLOAT ...": "0.5",
    "STR ...": "x",
    "--data.skip-frames": "0-9",
    "--data.window": "0-9",
}
"""Values of options without a default, by their name or by what the page calls them."""


class Parsed(BaseException):
    """Stops a command once its arguments are parsed: (args, what `parse` was called with)."""


@pytest.fixture
def parsed(monkeypatch):
    """Runs a command until its arguments are parsed; returns (args, class, page, default)."""

    def stop(cls, argv, command, page, default=None):
        raise Parsed(parse(cls, argv, command, page, default), cls, page, default)

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
    args, cls, help_, default = parsed(*examples(page)[0])
    words, named = [command], [each for each in options(cls, default) if not each.is_positional]
    for each in options(cls, default):
        value = each.default
        if value in (None, "", ()) or each.is_positional:
            value = VALUES.get(each.name) or VALUES.get(each.metavar) or re.findall(r"[\w-]+", each.metavar)[0]
        if each.is_flag:
            words.append(each.off if value else each.name)
        else:
            words += [] if each.is_positional else [each.name]
            words += map(str, value) if isinstance(value, tuple) else [str(value)]
        assert each.is_flag or re.search(rf"^  {re.escape(each.name)}\b", page, re.MULTILINE), each.name
    again = parsed(*words)[0]
    assert type(again) is type(args)
    shown = set(re.findall(r"^  (--[\w.-]+)", page, re.MULTILINE))
    assert shown <= {name for each in named for name in each.names} and len(shown) == len(named)
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
        (["c"], "endoprior train: expected DATA OUT, got c."),
        (["--iterations", "x"], "--iterations: expected an integer, got 'x'."),
        (["--device=gpu"], "--device: expected one of auto, cpu, cuda, got 'gpu'."),
        (["--view", "--view-port", "x"], "--view-port: expected an integer, got 'x'."),
        (["--min-valid", "3"], "got --min-valid. Fix: Did you mean --temporal.min-valid? "),
        (["--seed"], "--seed: expected an integer, got nothing."),
        (["--gaussians", "0"], "endoprior: --gaussians: budget must be in [1, 1e+07], got 0. Fix: "),
    ],
)
def test_a_wrong_option_is_named_with_what_was_meant(words, said, capsys):
    assert main(["train", "a", "b", *words]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1


@pytest.mark.parametrize(
    ("command", "option", "meant"),
    [
        ("run", "--fps", "--frames-per-second"),
        ("prepare", "--fps", "--frames-per-second"),
        ("train", "--epochs", "--iterations"),
        ("train", "--gpu", "--device"),
        ("export", "--force", "--overwrite"),
        ("export", "--fps", None),
        ("run", "--pose", "--poses"),
        ("run", "--depht", "--depth"),
        ("run", "--width", "--max-width"),
        ("train", "--lr", None),
    ],
)
def test_only_a_plausible_option_is_suggested(command, option, meant, capsys):
    assert main([command, "a", "b", option, "1"]) == 2
    said = f"Did you mean {meant}? `" if meant else "`"
    assert f"got {option}. Fix: {said}endoprior {command} --help-all`" in capsys.readouterr().err


def test_missing_arguments_are_named():
    from endoprior.cli.prepare import HELP, Prepare

    for words, missing in ((["a"], "no OUT"), ([], "no VIDEO and no OUT")):
        with pytest.raises(InputError, match=rf"^endoprior prepare: expected VIDEO OUT, got {missing}\. Fix: "):
            parse(Prepare, words, "prepare", HELP)
