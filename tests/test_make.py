"""`make` on machines that lack something, and with uv: programs that stand in for Python and uv."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TARGET = ".venv/.test-installed"
OLD = "sys.version_info = (3, 9, 2, 'final', 0)"
WITHOUT_VENV = "sys.modules['ensurepip'] = None"
PYTHON = f"python{sys.version_info.major}.{sys.version_info.minor}"
RECORDS = '#!/bin/sh\necho "{name} $*" >> calls\ncase "$*" in *.venv) mkdir -p .venv/bin; {then};; esac\n'

pytestmark = pytest.mark.skipif(not shutil.which("make"), reason="make is not installed")


@pytest.fixture
def checkout(tmp_path):
    """What `make` needs to install, and a folder of programs that is the whole PATH."""
    for name in ("Makefile", "constraints.txt", "pyproject.toml", "tools"):
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        copy(ROOT / name, tmp_path / name)
    programs = tmp_path / "programs"
    programs.mkdir()
    for name in ("make", "sh", "mkdir", "touch", "cp", "chmod"):
        (programs / name).symlink_to(shutil.which(name))
    return tmp_path


def program(checkout: Path, name: str, text: str) -> None:
    """Put a shell script into the checkout's PATH."""
    path = checkout / "programs" / name
    path.write_text(text)
    path.chmod(0o755)


def make(checkout: Path, *words: str, target: str = TARGET) -> subprocess.CompletedProcess[str]:
    """Run `make` in the checkout, with nothing but its programs."""
    ours = ("PYTHON", "TORCH_INDEX", "MAKEFLAGS", "MFLAGS", "MAKELEVEL")
    environment = {key: value for key, value in os.environ.items() if key not in ours}
    environment["PATH"] = str(checkout / "programs")
    return subprocess.run(
        ["make", *words, target], cwd=checkout, env=environment, capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize(
    ("name", "change", "says"),
    [
        ("python3", "", "expected Python 3.11 or newer, got none. Fix: Install it"),
        ("python3", OLD, "expected Python 3.11 or newer, got 3.9. Fix: Install it"),
        ("python9", OLD, "expected Python 3.11 or newer, got 3.9. Fix: Install it"),
        (
            "python3",
            WITHOUT_VENV,
            f"expected the modules venv and ensurepip, got none. Fix: `sudo apt install {PYTHON}-venv`",
        ),
    ],
)
def test_what_python_lacks_is_one_line_with_the_fix(checkout, name, change, says):
    if change:  # a Python that runs this statement before the code it is given
        text = f'exec {sys.executable} -c "import sys; {change}; exec(sys.argv[1])" "$2"'
        program(checkout, name, f"#!/bin/sh\n{text}\n")
    done = make(checkout, *([] if name == "python3" else [f"PYTHON={name}"]))
    lines = [line for line in done.stderr.splitlines() if not line.startswith("make")]
    assert done.returncode == 2 and len(lines) == 1 and lines[0].startswith(f"endoprior: {name}: {says}")
    assert not (checkout / ".venv").exists()


def calls(checkout: Path) -> list[str]:
    """The recorded calls of Python and uv, without the words that all of them have."""
    text = (checkout / "calls").read_text()
    for words in ("--constraint constraints.txt ", "--quiet ", "--disable-pip-version-check "):
        text = text.replace(words, "")
    return text.splitlines()


def test_pip_installs_torch_first(checkout):
    then = "cp programs/python3 .venv/bin/python; touch .venv/bin/pip"
    program(checkout, "python3", RECORDS.format(name="python", then=then))
    done = make(checkout)
    assert done.returncode == 0, done.stderr
    assert [line for line in calls(checkout) if " -c " not in line] == [
        "python -m venv .venv",
        "python -m pip install torch",
        "python -m pip install --editable .",
        "python -m pip install torch",
        "python -m pip install --editable .[test]",
    ]
    before = calls(checkout)
    assert make(checkout).returncode == 0 and calls(checkout) == before, "nothing is left to do"


def test_uv_is_used_where_it_is_and_takes_torch_from_the_index(checkout):
    program(checkout, "uv", RECORDS.format(name="uv", then="touch .venv/bin/python"))
    done = make(checkout, "PYTHON=python3.12", "TORCH_INDEX=https://index.example/cpu")
    assert done.returncode == 0, done.stderr
    install = "uv pip install --python .venv/bin/python"
    assert calls(checkout) == [
        "uv venv --seed --python python3.12 .venv",
        f"{install} --no-deps --index-url https://index.example/cpu torch",
        f"{install} --editable .",
        f"{install} --no-deps --index-url https://index.example/cpu torch",
        f"{install} --editable .[test]",
    ]
    # Without a Python or an index, uv chooses.
    shutil.rmtree(checkout / ".venv")
    (checkout / "calls").unlink()
    assert make(checkout).returncode == 0
    assert calls(checkout)[:2] == ["uv venv --seed .venv", f"{install} torch"]


@pytest.mark.parametrize("installed", [True, False])
def test_docs_do_not_change_how_the_program_is_installed(checkout, installed):
    answers = f'case "$*" in *m.version*) exit {1 - installed};; *tomllib*) echo "furo>=2 sphinx>=8";; esac'
    program(checkout, "python3", RECORDS.format(name="python", then="true") + answers)
    (checkout / ".venv" / "bin").mkdir(parents=True)
    shutil.copy(checkout / "programs" / "python3", checkout / ".venv" / "bin" / "python")
    (checkout / ".venv" / "bin" / "pip").touch()
    done = make(checkout, target=".venv/.docs-installed")
    assert done.returncode == 0, done.stderr
    whole = ["python -m pip install torch", "python -m pip install --editable .[docs]"]
    wanted = ["python -m pip install furo>=2 sphinx>=8"] if installed else whole
    assert [line for line in calls(checkout) if "pip install" in line] == wanted


@pytest.mark.parametrize("how", ["False", "True", "absent"])
def test_a_plain_installation_stays_one(checkout, how):
    answer = 'case "$*" in *direct_url*) ' + ("exit 1" if how == "absent" else f"echo {how}") + ";; esac"
    program(checkout, "python3", RECORDS.format(name="python", then="true") + answer)
    (checkout / ".venv" / "bin").mkdir(parents=True)
    shutil.copy(checkout / "programs" / "python3", checkout / ".venv" / "bin" / "python")
    (checkout / ".venv" / "bin" / "pip").touch()
    done = make(checkout, target=".venv/.installed")
    assert done.returncode == 0, done.stderr
    assert calls(checkout)[-1] == f"python -m pip install {'' if how == 'False' else '--editable '}."


def ready_for_tests(checkout: Path) -> None:
    """A checkout whose `.venv` is complete; its Python and ruff record their calls."""
    (checkout / ".venv" / "bin").mkdir(parents=True)
    for name in ("python", "ruff"):
        program(checkout, name, f'#!/bin/sh\necho "{name} $*" >> calls\n')
        (checkout / "programs" / name).rename(checkout / ".venv" / "bin" / name)
    for name in (".installed", ".test-installed"):
        (checkout / ".venv" / name).touch()


@pytest.mark.parametrize("has_browser", [True, False])
def test_make_test_installs_no_browser_and_says_that_there_is_none(checkout, has_browser):
    ready_for_tests(checkout)
    program(checkout, "id", "#!/bin/sh\necho 0\n")
    program(checkout, "apt-get", '#!/bin/sh\necho "apt-get $*" >> calls\n')
    if has_browser:
        program(checkout, "chromium", "#!/bin/sh\n")
    done = make(checkout, target="test")
    assert done.returncode == 0, done.stderr
    assert not [line for line in calls(checkout) if "apt-get" in line]
    assert ("Fix: make browser" in done.stdout) is not has_browser


@pytest.mark.parametrize("user", ["0", "1000"])
def test_make_browser_installs_one_or_names_the_command(checkout, user):
    program(checkout, "id", f"#!/bin/sh\necho {user}\n")
    program(checkout, "apt-get", '#!/bin/sh\necho "apt-get $*" >> calls\n')
    done = make(checkout, target="browser")
    if user == "0":
        assert done.returncode == 0 and "install -y --no-install-recommends chromium" in calls(checkout)[-1]
    else:
        assert done.returncode == 2 and "got none. Fix: sudo apt-get install chromium" in done.stderr
        assert not (checkout / "calls").exists()
    (checkout / "calls").unlink(missing_ok=True)
    program(checkout, "chromium", "#!/bin/sh\n")
    assert make(checkout, target="browser").returncode == 0 and not (checkout / "calls").exists()
