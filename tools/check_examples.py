"""Check the types of the Python examples of README, the documentation and examples/: `python tools/check_examples.py`.

Each block becomes a file below build/examples, named after its page and line, so that an error of pyright leads there.
That folder is a project of its own, as a user's: pyright finds endoprior as an installed library, of which only those
names may be imported from a module that it defines or exports.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted(ROOT.glob("docs/*.md"))]
SCRIPTS = sorted(ROOT.glob("examples/*.py"))
OUT = ROOT / "build" / "examples"
SETTINGS = {"typeCheckingMode": "standard"}
"""Pyright's own default; without a file of settings it would take ours, and its search path."""
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
PLACE = re.compile(r"`src/([\w/]+)/NAME\.py`")
"""Where a page says that the block after it belongs: what its relative imports start from."""


def examples(page: Path) -> Iterator[tuple[str, str]]:
    """Name and text of the file that each block of a page becomes."""
    text = page.read_text(encoding="utf-8")
    for block in BLOCK.finditer(text):
        line = text.count("\n", 0, block.start()) + 2
        places = PLACE.findall(text[: block.start()])
        yield f"{page.stem}_line_{line}.py", absolute(block[1], places[-1].split("/") if places else [])


def absolute(code: str, package: list[str]) -> str:
    """The code with absolute imports in place of those relative to a package."""

    def named(found: re.Match[str]) -> str:
        base = package[: len(package) - len(found[1]) + 1]
        return f"from {'.'.join([*base, found[2]])} import"

    return re.sub(r"^from (\.+)([\w.]+) import", named, code, flags=re.MULTILINE)


def main() -> int:
    """Write the examples, and let pyright check them; its exit status."""
    shutil.rmtree(OUT, ignore_errors=True)
    OUT.mkdir(parents=True)
    for name, text in (each for page in PAGES for each in examples(page)):
        (OUT / name).write_text(text, encoding="utf-8")
    for script in SCRIPTS:
        shutil.copy(script, OUT)
    (OUT / "pyrightconfig.json").write_text(json.dumps(SETTINGS), encoding="utf-8")
    words = [sys.executable, "-m", "pyright", "--pythonpath", sys.executable, "--project", str(OUT)]
    return subprocess.run(words, cwd=ROOT, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
