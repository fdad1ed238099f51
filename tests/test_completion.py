"""`endoprior completion SHELL`: the script knows every command and option, and bash completes with it."""

from __future__ import annotations

import shutil
import subprocess

import pytest

from endoprior.cli import descriptions, main

SHELLS = ("bash", "zsh", "fish")
ASK = """
source completion.bash
ask() {
    COMP_WORDS=("$@") COMP_CWORD=$(($# - 1)) COMPREPLY=()
    $(complete -p endoprior | sed -E 's/.*-F ([^ ]+).*/\\1/')
    echo "${COMPREPLY[*]}"
}
"""
"""What bash does when Tab is typed: it calls the function that is registered, with the words so far."""


@pytest.fixture
def script(capsys):
    def printed(shell):
        assert main(["completion", shell]) == 0
        return capsys.readouterr().out

    return printed


@pytest.mark.parametrize("shell", SHELLS)
def test_a_script_knows_every_command_and_options_of_ours_and_of_plugins(script, shell):
    text = script(shell)
    assert all(name in text for name in descriptions())
    for option in ("--preview", "--known-length", "--init.budget", "--report-only", "--help-all"):
        assert option in text or option.removeprefix("--") in text, option
    if shutil.which(shell):
        subprocess.run([shell, "-n"], input=text, text=True, check=True)


@pytest.mark.skipif(not shutil.which("bash"), reason="no bash here: what the script completes is not tried")
def test_bash_completes_commands_options_choices_and_files(script, tmp_path):
    (tmp_path / "completion.bash").write_text(script("bash"))
    (tmp_path / "video_1.mp4").touch()

    def completed(*words):
        asked = " ".join(f"'{word}'" for word in ("endoprior", *words))
        done = subprocess.run(["bash", "-c", f"{ASK}ask {asked}"], cwd=tmp_path, capture_output=True, text=True)
        assert not done.stderr
        return set(done.stdout.split())

    assert completed("tra") == {"train"} and completed("") >= {*descriptions()}
    assert completed("run", "--pre") == {"--preview", "--preset"}
    assert completed("train", "a", "b", "--init.bud") == {"--init.budget"}
    assert completed("train", "a", "b", "--preset", "p") == {"paper", "preview"}
    assert completed("run", "vid") == completed("run", "a", "b", "--calibration", "vid") == {"video_1.mp4"}
    assert completed("completion", "") == {*SHELLS}


def test_another_shell_is_named(capsys):
    assert main(["completion", "zssh"]) == 2
    text = capsys.readouterr().err
    assert "SHELL: invalid choice: 'zssh' (choose from 'bash', 'zsh', 'fish'). Fix: `endoprior completion zsh`." in text
