"""Write a sequence folder from a video: select frames, rectify, crop, mask tools, measure depth, estimate poses."""

from .config import PrepareConfig
from .pipeline import Prepared, prepare

__all__ = ["PrepareConfig", "Prepared", "prepare"]
