"""The documents, taken at their word: links lead somewhere, commands and code parse, named files exist."""

from __future__ import annotations

import ast
import re
import shlex
import subprocess
import sys
from contextlib import suppress
from functools import cache
from pathlib import Path
from pkgutil import resolve_name
from urllib.parse import unquote

import pytest
import shtab
import yaml
from command_modules import parsed
from markdown_it import MarkdownIt
from markdown_it.token import Token

from endoprior.cli import REGISTRY, descriptions
from endoprior.cli.completion import whole_parser

ROOT = Path(__file__).parents[1]
PAGES = sorted({*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")})
COMMANDS_OF_THE_LOG = ROOT / "docs" / "log.md"
"""What it tells of belongs to earlier versions."""
CURRENT = [page for page in PAGES if page not in (COMMANDS_OF_THE_LOG, ROOT / "CHANGELOG.md")]
ELSEWHERE = ("http://", "https://", "mailto:")
TARGETS = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
OWN_PATH = re.compile(r"(?<![\w/])(?:bench|docs|faults|src|tests)/[\w./*-]+")
OPTIONS_OF_OTHERS = {"--areas-weight", "--extra-index-url", "--gpus", "--index-url", "--per_obj_png_file", "--run"}
"""Of pip, Docker and SAM 2, of the example of a method, and of a script in bench/."""
PLACEHOLDERS = {"COMMAND", "...", "NAME"}
"""Words that stand for a command, a choice or the rest of a line."""


@cache
def tokens(page: Path) -> list[Token]:
    """Everything on a page, inline parts too, in order."""
    blocks = MarkdownIt("commonmark").enable("table").parse(page.read_text(encoding="utf-8"))
    return [token for block in blocks for token in (block, *(block.children or ()))]


@cache
def anchors(page: Path) -> set[str]:
    """The names that GitHub and the site give to the headings of a page."""
    found = tokens(page)
    titles = [found[i + 1].content for i, token in enumerate(found) if token.type == "heading_open"]
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def code_lines(page: Path) -> list[str]:
    """The lines of code blocks without a language, and the code inside of sentences."""
    blocks = [token for token in tokens(page) if token.type in ("fence", "code_block") and not token.info]
    lines = [line for token in blocks for line in token.content.splitlines()]
    return lines + [" ".join(token.content.split()) for token in tokens(page) if token.type == "code_inline"]


def commands(page: Path) -> list[list[str]]:
    """The words of each `endoprior` command on a page that has arguments."""
    found = []
    for line in code_lines(page):
        for part in re.split(r"&&|\s#\s.*", line):
            words = part.replace(".venv/bin/", "").split()
            if words[:1] == ["endoprior"] and len(words) > 2 and not PLACEHOLDERS & set(words):
                found.append(shlex.split(part.replace(".venv/bin/", ""))[1:])
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_and_images_lead_somewhere(page):
    for token in tokens(page):
        target = token.attrGet({"link_open": "href", "image": "src"}.get(token.type, ""))
        if not target or str(target).startswith(ELSEWHERE):
            continue
        name, _, anchor = unquote(str(target)).partition("#")
        path = (page.parent / name).resolve() if name else page
        assert path.exists(), f"{page.name}: {target}: there is no such file"
        assert not anchor or anchor in anchors(path), f"{page.name}: {target}: there is no such heading"


@pytest.mark.parametrize("page", CURRENT, ids=lambda page: page.name)
def test_commands_parse(page):
    for name, *rest in commands(page):
        assert name in descriptions(), f"{page.name}: endoprior {name}: there is no such command"
        try:
            with suppress(SystemExit):  # --help exits
                parsed(name, *rest)
        except ValueError as error:
            pytest.fail(f"{page.name}: endoprior {name} {' '.join(rest)}: {error}")


@cache
def known_options() -> set[str]:
    """Every long option of every command, and the short names of fields of the config."""
    listed = re.findall(r"--[a-z][a-z0-9.-]*[a-z0-9]", shtab.complete(whole_parser(), "bash"))
    return {*listed, *REGISTRY.load("train").short, *OPTIONS_OF_OTHERS}


@pytest.mark.parametrize("page", CURRENT, ids=lambda page: page.name)
def test_options_in_sentences_exist(page):
    for token in tokens(page):
        option = re.match(r"--[a-z][\w.-]*", token.content) if token.type == "code_inline" else None
        if option and not option[0].endswith("."):
            assert option[0] in known_options(), f"{page.name}: {option[0]}: no command has this option"


@pytest.mark.parametrize("page", CURRENT, ids=lambda page: page.name)
def test_targets_of_make_and_files_exist(page):
    for line in code_lines(page):
        for target in re.findall(r"(?:^|\s)make ([a-z][a-z-]*)", line):
            assert target in TARGETS, f"{page.name}: make {target}: there is no such target"
        for path in OWN_PATH.findall(line):
            if "NAME" not in path:
                assert any(ROOT.glob(path.rstrip("/."))), f"{page.name}: {path}: there is no such file"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_python_and_yaml_parse(page):
    for token in tokens(page):
        if token.type == "fence" and token.info == "python":
            ast.parse(token.content, f"{page.name}:{token.map[0] + 1}")
        elif token.type == "fence" and token.info == "yaml":
            yaml.safe_load(token.content)


@pytest.mark.slow
def test_the_types_of_python_examples_fit():
    done = subprocess.run([sys.executable, ROOT / "tools" / "check_examples.py"], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
    pages = {path.name.partition("_line_")[0] for path in (ROOT / "build" / "examples").iterdir()}
    assert pages >= {"README", "export"}


def test_there_is_something_to_check():
    """The patterns above match: a page that shows every kind."""
    assert ["train", "DATA", "RUN"] in commands(ROOT / "README.md") and "your-own-video" in anchors(ROOT / "README.md")
    assert sum(len(commands(page)) for page in PAGES) > 50 and {"test", "docs"} <= TARGETS


def test_paper_map_names_functions_and_tests_that_exist():
    table = (ROOT / "docs" / "paper_map.md").read_text(encoding="utf-8").partition("\n## ")[0]
    for name in re.findall(r"`(\w+(?:\.\w+)+)`", table):
        if name.endswith(".py"):
            assert (ROOT / "tests" / name).is_file(), name
        else:
            assert resolve_name(f"endoprior.{name}"), name


def test_page_of_check_names_every_problem():
    lines = re.findall(r"^- (`.*?) \(", (ROOT / "docs" / "check.md").read_text(), re.MULTILINE)
    source = "".join(file.read_text() for file in (ROOT / "src" / "endoprior" / "check").glob("*.py"))
    codes = set(re.findall(r"`([a-z0-9-]+)`", " ".join(lines)))
    assert codes and all(f'"{code}"' in source for code in codes)
    assert codes >= set(re.findall(r'Finding\("([a-z0-9-]+)"', source))
