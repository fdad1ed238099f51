"""Printing lines for the user."""

from __future__ import annotations

import sys


def say(text: str) -> None:
    """Print one line and flush it. Characters that the terminal's encoding lacks are written as \\xNN."""
    encoding = sys.stdout.encoding or "utf-8"
    print(text.encode(encoding, "backslashreplace").decode(encoding), flush=True)
