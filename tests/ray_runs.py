"""What tests of Ray clusters and batches share."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import replace

import pytest
from tiny_training import tiny_config

from endoprior.core.config import Config, WindowConfig

needs_ray = pytest.mark.skipif(
    importlib.util.find_spec("ray") is None or sys.platform != "linux", reason="no Ray, or not Linux"
)


def in_windows(fine: int) -> Config:
    """Quick training, in three windows for 20 frames."""
    windows = WindowConfig(longest=10)
    return replace(tiny_config("basis", fine=fine), windows=windows)


def silent(text: str) -> None:
    """No lines."""
