"""What this machine can do: `look` finds facts, `examine` decides from them what works and what to install."""

from .facts import glance, look
from .judge import Report, examine
from .lines import Line
from .records import Facts

__all__ = ["Facts", "Line", "Report", "examine", "glance", "look"]
