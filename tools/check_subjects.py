"""Check the first lines of commit messages: `python tools/check_subjects.py FILE`, or `... --commits BASE..HEAD`.

The hook `commit-msg` gives the file of one message, CI the commits of a push or a pull request.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

MAX_LENGTH = 72
"""What `git log --oneline` and web pages show without cutting it."""


def problem(subject: str) -> str | None:
    """What is wrong with a first line; None if nothing is."""
    if not subject.strip():
        return "expected a first line, got none"
    if len(subject) > MAX_LENGTH:
        return f"{subject!r}: expected at most {MAX_LENGTH} characters, got {len(subject)}"
    return None


def subjects_of(commits: str) -> list[str]:
    """The first lines of a range of commits, as git has them."""
    words = ["git", "log", "--no-merges", "--format=%s", commits, "--"]
    return subprocess.run(words, stdout=subprocess.PIPE, text=True, encoding="utf-8", check=True).stdout.splitlines()


def main() -> None:
    """Print what is wrong; exit status 1 if anything is."""
    parser = argparse.ArgumentParser(description=__doc__)
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument("file", nargs="?", type=Path, help="one message, as git gives it to the hook")
    which.add_argument("--commits", metavar="BASE..HEAD", help="a range of commits")
    arguments = parser.parse_args()
    if arguments.commits:
        subjects = subjects_of(arguments.commits)
    else:
        subjects = arguments.file.read_text(encoding="utf-8").splitlines()[:1] or [""]
    problems = [text for subject in subjects if (text := problem(subject))]
    sys.exit("\n".join(problems) or 0)


if __name__ == "__main__":
    main()
