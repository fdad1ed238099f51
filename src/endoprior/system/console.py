"""Printing lines for the user."""

from __future__ import annotations


def say(text: str) -> None:
    """Print one line and flush it."""
    print(text, flush=True)
