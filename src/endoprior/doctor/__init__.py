"""What this machine can do: `read_facts` reads facts, `examine` decides from them what works and what to install."""

from .diagnosis import Report, examine
from .facts import read_facts, read_facts_quickly
from .lines import Line
from .records import Facts

__all__ = ["Facts", "Line", "Report", "examine", "read_facts", "read_facts_quickly"]
