"""What a training found out about tool masks: how far tools color pixels around them, and where they miss a tool."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ..model.windowed_scene import window_file
from .folder import CONFIG, SCENE
from .missed_tools import KEY, missed_tools_of

MARGIN = "tool_margin_px"
"""In `config.json` of a run, and in the protocol of `metrics.json`."""


def mask_facts(run: Path) -> dict[str, Any]:
    """For the protocol of `metrics.json`: the facts that the training in a run folder knows."""
    facts = {MARGIN: tool_margin_of(run), KEY: missed_tools_of(run)}
    return {name: fact for name, fact in facts.items() if fact is not None}


def tool_margin_of(run: Path) -> int | list[int] | None:
    """Pixels around tool masks that a training left out, one number for each window; None where that was not asked."""
    about = _read(run / CONFIG)
    windows = about.get("windows")
    if not isinstance(windows, list):
        return _margin(about)
    margins = [_margin(_read(window_file(run / SCENE, k).parent / CONFIG)) for k in range(len(windows))]
    return None if None in margins else margins


def margin_note(margin_px: int) -> str:
    """For the user: what was measured."""
    if not margin_px:
        return "tools do not color the pixels around their masks: none is left out"
    return f"tools color {margin_px} px around their masks, which are left out"


def _margin(about: dict[str, Any]) -> int | None:
    margin = about.get(MARGIN)
    return margin if isinstance(margin, int) else None


def _read(file: Path) -> dict[str, Any]:
    """A `config.json`; empty where there is none that can be read."""
    try:
        about = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return about if isinstance(about, dict) else {}
