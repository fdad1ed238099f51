"""What pyproject.toml cannot say: a built package holds the commit it was built from, and the documentation."""

import shutil
import subprocess
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py
from setuptools.command.sdist import sdist

ROOT = Path(__file__).parent
STAMP = "commit.txt"
"""Read by src/endoprior/system/installation.py."""


def stamp(package: Path) -> None:
    """Write the commit into a folder; in a source package, which has no repository, it is already known."""
    given = ROOT / "src" / "endoprior" / STAMP
    if given.is_file():
        text = given.read_text(encoding="utf-8")
    elif (ROOT / ".git").exists() and shutil.which("git"):
        words = ["git", "describe", "--always", "--abbrev=12", "--dirty=+", "--exclude=*"]
        text = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False).stdout
    else:
        text = ""
    if text:
        (package / STAMP).write_text(text, encoding="utf-8")


class BuildPackage(build_py):
    """Adds docs/ without the log, and the commit, except to an editable installation, which runs from the checkout."""

    def run(self) -> None:
        """Copy the package, then add what it has not."""
        shutil.rmtree(self.build_lib, ignore_errors=True)  # a module that is gone must not stay
        super().run()
        if not self.editable_mode:
            package = Path(self.build_lib, "endoprior")
            ignored = shutil.ignore_patterns("log.md", "__pycache__")
            shutil.copytree(ROOT / "docs", package / "docs", ignore=ignored, dirs_exist_ok=True)
            stamp(package)


class SourcePackage(sdist):
    """Adds the commit."""

    def make_release_tree(self, base_dir: str, files: list[str]) -> None:
        """Copy the files, then add the commit."""
        super().make_release_tree(base_dir, files)
        stamp(Path(base_dir, "src", "endoprior"))


setup(cmdclass={"build_py": BuildPackage, "sdist": SourcePackage})
