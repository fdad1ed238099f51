"""Text that is safe to show: names of files, notes and titles may come from somebody else."""

from __future__ import annotations

import re
import unicodedata


def printable(text: str) -> str:
    r"""The text with `\x1b` and the like in place of characters that a terminal obeys or that turn the text around.

    Newlines, tabs and spaces of any width stay.
    """
    return text if text.isprintable() else "".join(map(_shown, text))


def quotation(text: str) -> str:
    """Text from a file or a name, without what would pass for advice of this program: backticks and `Fix:`."""
    return re.sub(r"\bfix\s*:", "fix", text.replace("`", "'"), flags=re.IGNORECASE)


def _shown(character: str) -> str:
    if character.isprintable() or character in "\n\t" or unicodedata.category(character) == "Zs":
        return character
    return character.encode("unicode_escape").decode("ascii")
