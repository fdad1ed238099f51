"""Files beside the source: citation and container image agree with the project."""

import re
import tomllib
from pathlib import Path

import yaml

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_the_citation_is_of_this_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert {"cff-version", "message", "title", "abstract", "authors", "version"} <= citation.keys()
    assert (citation["cff-version"], str(citation["version"])) == ("1.2.0", PROJECT["version"])
    assert (citation["title"], citation["license"]) == (PROJECT["name"], PROJECT["license"])
    assert citation["authors"] == PROJECT["authors"] and citation["keywords"] == PROJECT["keywords"]
    (paper,) = citation["references"]
    readme = (ROOT / "README.md").read_text()
    assert f"version = {{{PROJECT['version']}}}" in readme
    assert " and ".join(f"{each['family-names']}, {each['given-names']}" for each in paper["authors"]) in readme
    assert paper["url"] == PROJECT["urls"]["Paper"] and paper["url"] in readme


def test_the_image_is_small_and_copies_what_exists():
    lines = (ROOT / "Dockerfile").read_text().splitlines()
    allowed = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    assert len(lines) <= 25
    copied = {source for line in lines if line.startswith("COPY ") for source in line.split()[1:-1]}
    assert copied == allowed and all((ROOT / source).exists() for source in copied)
    (user,) = re.findall(r"^USER (\S+)$", "\n".join(lines), re.MULTILINE)
    assert user not in ("root", "0")
