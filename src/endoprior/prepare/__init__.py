"""Write a sequence folder from a video: select frames, rectify, crop, mask tools, measure depth, estimate poses."""

from ..core.callable_package import make_callable
from .config import PrepareConfig
from .pipeline import Prepared, prepare

__all__ = ["PrepareConfig", "Prepared", "prepare"]

make_callable(__name__, prepare)
