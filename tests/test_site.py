"""The documentation site: it builds without a warning, without the network, and shows every command and field."""

import re
import subprocess
import sys
from html import unescape
from pathlib import Path

import pytest

import endoprior
from endoprior.cli import descriptions
from endoprior.core.config import Config
from endoprior.core.config_io import to_dict
from endoprior.evaluation.registry import all_scores

ROOT = Path(__file__).parents[1]
PAGES_LISTED = re.compile(r"^(?:\.\./)?[\w/]+$", re.MULTILINE)
FETCHED = re.compile(
    r"""<(?:script|img|iframe|source|video|audio|embed)\b[^>]*\bsrc=["']?(?:https?:)?//[^"'>]*"""
    r"""|<link\b(?![^>]*rel=["']?(?:canonical|next|prev))[^>]*\bhref=["']?(?:https?:)?//[^"'>]*"""
    r"""|(?:url\(|@import)\s*["']?(?:https?:)?//[^"')]*""",
    re.IGNORECASE,
)
"""What a browser would fetch from the network to show a page or a style sheet."""


def field_names(values: dict, prefix: str = "") -> list[str]:
    """Dotted names of all fields of a config."""
    return [
        name
        for key, value in values.items()
        for name in (field_names(value, f"{prefix}{key}.") if isinstance(value, dict) else [f"{prefix}{key}"])
    ]


def test_every_page_is_in_the_table_of_contents():
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    listed = set(PAGES_LISTED.findall(index))
    pages = {page.stem for page in ROOT.glob("docs/*.md")} - {"index"}
    pages |= {f"../{page.stem}" for page in ROOT.glob("*.md")}
    pages |= {f"notebooks/{page.stem}" for page in ROOT.glob("docs/notebooks/*.ipynb")}
    assert pages <= listed, f"add to docs/index.md: {', '.join(sorted(pages - listed))}"


def test_every_public_name_is_in_the_reference():
    page = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    for name in endoprior.__all__:
        assert f":: endoprior.{name}" in page, name


@pytest.mark.parametrize(
    ("text", "is_fetched"),
    [
        ('<script src="https://cdn.net/a.js"></script>', True),
        ("<link rel='stylesheet' href='//fonts.net/a.css'>", True),
        ("@import 'https://fonts.net/a.css'", True),
        ('<a href="https://example.org">', False),
        ('<script src="../_static/a.js"></script>', False),
    ],
)
def test_what_comes_from_the_network_is_recognized(text, is_fetched):
    assert bool(FETCHED.search(text)) == is_fetched


@pytest.mark.slow
def test_the_site_builds_and_is_complete_without_the_network(tmp_path):
    words = ["-m", "sphinx", "-W", "--keep-going", "-q", "-c", "docs", ".", str(tmp_path)]
    done = subprocess.run([sys.executable, *words], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-4000:]
    assert (tmp_path / "index.html").is_file() and (tmp_path / "docs" / "index.html").is_file()
    for file in tmp_path.rglob("*"):
        if file.suffix in (".html", ".css"):
            assert not (found := FETCHED.search(file.read_text(encoding="utf-8"))), f"{file}: {found[0]}"
    commands, config = ((tmp_path / "docs" / f"{name}.html").read_text(encoding="utf-8") for name in ("cli", "config"))
    for name in descriptions():
        assert f"usage: endoprior {name}" in unescape(commands), name
    for name in field_names(to_dict(Config())):
        assert f">{name}<" in config, name
    scores = (tmp_path / "docs" / "scores.html").read_text(encoding="utf-8")
    shown = unescape(re.sub("<[^>]*>", "", scores))
    for name, score in all_scores().items():
        if not score.in_summary and not name.endswith(("_dis", "_still")):
            said = score.description.partition("'")[0].replace("`", "")  # the site has curved quotation marks
            assert said in shown, name
    method = (tmp_path / "docs" / "method.html").read_text(encoding="utf-8")
    assert method.count("<math") > 20 and "$" not in re.sub(r"<(script|math).*?</\1>", "", method, flags=re.DOTALL)
    compared = (tmp_path / "docs" / "notebooks" / "compare_methods.html").read_text(encoding="utf-8")
    assert "<table" in compared and "<img" in compared
