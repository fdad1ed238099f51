"""From a video to a sequence folder: what is cut out, masked, measured and written."""

from .config import PrepareConfig
from .pipeline import Prepared, prepare

__all__ = ["PrepareConfig", "Prepared", "prepare"]
