"""What differs between systems, looked up in the source: encodings, modules of one system, unlike calls."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
FILES = sorted(path for folder in ("src", "bench", "faults") for path in (ROOT / folder).rglob("*.py"))
SOURCE = [path for path in FILES if "src" in path.relative_to(ROOT).parts]
ONE_SYSTEM = {"fcntl", "grp", "msvcrt", "posix", "pty", "pwd", "resource", "syslog", "termios", "tty", "winreg"}
"""Modules that some systems do not have."""
DIFFERENT = {
    "os.kill": "ends the process on Windows: psutil.pid_exists",
    "os.getuid": "not on Windows",
    "os.fork": "not on Windows",
    "cv2.imread": "no names beyond ASCII on Windows: data.images.decode_image",
    "cv2.imwrite": "no names beyond ASCII on Windows: data.images.save_png",
}
"""Calls that must not be in the source."""


@cache
def tree_of(path: Path) -> ast.Module:
    """A file's syntax tree."""
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def nodes(path: Path) -> list[ast.AST]:
    """Every node of it."""
    return list(ast.walk(tree_of(path)))


def last_name(function: ast.expr) -> str:
    """`open` for `open`, `path.open` and `a[0].open`."""
    return getattr(function, "attr", getattr(function, "id", ""))


def is_text_without_encoding(call: ast.Call) -> bool:
    """Whether a call opens, reads or writes text in the system's encoding."""
    given = {keyword.arg: keyword.value for keyword in call.keywords}
    name = last_name(call.func)
    if "encoding" in given:
        return False
    if name == "open" and ast.unparse(call.func) in ("av.open", "os.open", "archive.open"):  # they are binary
        return False
    if name in ("read_text", "write_text"):
        return isinstance(call.func, ast.Attribute) and len(call.args) <= (name == "write_text")
    if name in ("open", "fdopen", "TemporaryFile", "NamedTemporaryFile"):
        words = [value.value for value in (*call.args, *given.values()) if isinstance(value, ast.Constant)]
        modes = [word for word in words if isinstance(word, str) and re.fullmatch("[rwxabt+]+", word)]
        return "b" not in (modes or ["w+b" if name.endswith("File") else "r"])[0]
    return "text" in given or "universal_newlines" in given


@pytest.mark.parametrize(
    ("code", "wrong"),
    [
        ("open(path)", True),
        ("open(path, 'a', buffering=1)", True),
        ("path.open('w')", True),
        ("path.open()", True),
        ("path.read_text()", True),
        ("path.write_text(text)", True),
        ("tempfile.TemporaryFile('w+')", True),
        ("subprocess.run(words, text=True)", True),
        ("open(path, 'rb')", False),
        ("open(path, encoding='utf-8')", False),
        ("path.open('wb')", False),
        ("path.read_text('utf-8')", False),
        ("write_text(path, text)", False),
        ("tempfile.TemporaryFile()", False),
        ("subprocess.run(words, encoding='utf-8')", False),
    ],
)
def test_text_without_an_encoding_is_recognized(code, wrong):
    assert is_text_without_encoding(ast.parse(code).body[0].value) is wrong


def test_text_has_an_encoding():
    for path in FILES:
        for node in nodes(path):
            if isinstance(node, ast.Call):
                assert not is_text_without_encoding(node), f"{path}:{node.lineno}: add encoding='utf-8'"


def test_modules_of_one_system_are_imported_where_they_are_used():
    for path in SOURCE:
        for node in tree_of(path).body:
            if isinstance(node, ast.Import | ast.ImportFrom):
                names = {alias.name for alias in node.names} | {getattr(node, "module", None)}
                assert not names & ONE_SYSTEM, f"{path}:{node.lineno}: import it in a function, in a `try`"


def test_calls_that_differ_between_systems_are_not_used():
    called = {name.split(".")[-1] for name in DIFFERENT}
    for path in SOURCE:
        for node in nodes(path):
            if last_name(node) in called and (name := ast.unparse(node)) in DIFFERENT:
                raise AssertionError(f"{path}:{node.lineno}: {name}: {DIFFERENT[name]}")


def test_relative_paths_become_text_with_slashes():
    for path in SOURCE:
        used = {id(node.value) for node in nodes(path) if isinstance(node, ast.Attribute)}
        for node in nodes(path):
            if isinstance(node, ast.Call) and last_name(node.func) == "relative_to":
                assert id(node) in used, f"{path}:{node.lineno}: add .as_posix() or .parts"


def test_the_workflow_runs_what_it_names():
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "test.yml").read_text(encoding="utf-8"))
    (job,) = workflow["jobs"].values()
    assert {name.split("-")[0] for name in job["strategy"]["matrix"]["os"]} == {"ubuntu", "macos", "windows"}
    oldest = re.search(r'requires-python = ">=([\d.]+)"', (ROOT / "pyproject.toml").read_text(encoding="utf-8"))[1]
    assert oldest in job["strategy"]["matrix"]["python"]
    steps = "\n".join(step.get("run", "") for step in job["steps"])
    assert "make" not in steps  # Windows has none
    for word in ("-c constraints.txt", "pytest -n 2 --dist loadfile", "ruff check", "ruff format --check"):
        assert word in steps
