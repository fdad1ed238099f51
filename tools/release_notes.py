"""Print what changed in a version, for its release: `python tools/release_notes.py v0.2.0`.

The tag must be the version of pyproject.toml, and CHANGELOG.md must have a dated section for it.
"""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
HEADING = re.compile(r"^## (?P<version>\S+) - (?P<date>\d{4}-\d{2}-\d{2})$", re.MULTILINE)


def notes(tag: str) -> str:
    """The section of CHANGELOG.md that belongs to this tag, without its heading."""
    version = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    if tag != f"v{version}":
        sys.exit(f"{tag}: expected the tag v{version}, which is the version in pyproject.toml")
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    for match in HEADING.finditer(text):
        if match["version"] == version:
            return re.split(r"^## ", text[match.end() :], maxsplit=1, flags=re.MULTILINE)[0].strip()
    sys.exit(f"CHANGELOG.md: expected a heading `## {version} - YYYY-MM-DD`, got none")


if __name__ == "__main__":
    print(notes(sys.argv[1]))
