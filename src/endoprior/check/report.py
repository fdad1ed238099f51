"""Print the facts as a table, and convert facts and findings to JSON."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..core.checks import quotation
from ..core.geometry import length_unit
from ..data.reading import read_parts
from ..footage.border import CERTAIN
from .facts import Facts
from .findings import Finding


def table(facts: Facts) -> list[tuple[str, str]]:
    """Rows of (name, value), in the order of the report."""
    camera, depth, border, changes = facts.camera, facts.depth, facts.border, facts.changes
    rate = facts.frames_per_second
    seconds = f", {facts.frames / rate:.1f} s at {rate:g} frames/s" if rate else ", rate unknown"
    tool, unit = facts.masks.tool_fraction, length_unit(depth.relative)
    value = "high" if facts.described.get("mask_tool_value", 255) == 255 else "low"
    rows = [
        ("frames", f"{facts.frames}: {facts.train_frames} to train, {facts.test_frames} to test{seconds}"),
        ("images", f"{camera.width} x {camera.height} px{', stereo' if facts.stereo else ''}"),
        (
            "intrinsics",
            f"fx {camera.fx:g}, fy {camera.fy:g}, cx {camera.cx:g}, cy {camera.cy:g} px; {facts.view_deg:.0f} degrees",
        ),
        ("camera", _camera_words(facts)),
        *([("poses fit", facts.pose_fit.reason)] if facts.pose_fit else []),
        ("image motion", facts.motion.reason),
        ("tools", f"{tool.mean():.1%} of the pixels inside the border ({tool.min():.1%} to {tool.max():.1%})"),
        ("mask polarity", f"read as tool = {value}; {facts.masks.reason}"),
        ("border", _border_words(facts)),
        ("labels", f"{len(border.overlays)} burned in and not masked"),
        (
            "depth",
            f"{depth.low:.4g} to {depth.high:.4g}, median {depth.unit.median:.4g} {unit}"
            f"{'' if depth.relative or depth.known else ', if the unit is right'}",
        ),
        ("depth unit", f"{depth.unit.unit if _unit_is_guessed(facts) else unit}: {unit_reason(facts)}"),
        (
            "depth coverage",
            f"{depth.coverage.mean():.1%} of tissue ({depth.coverage.min():.1%} to {depth.coverage.max():.1%})",
        ),
        *([] if depth.measured is None else [("depth measured", f"by parallax on {depth.measured:.0%} of the tissue")]),
        (
            "depth resolution",
            f"steps of {depth.step:.3g}, {f'{depth.bits} bits a value' if depth.bits else 'bits unknown'}",
        ),
        (
            "changes",
            f"{len(changes.duplicates)} copies, {len(changes.exposure_jumps)} exposure jumps, {len(changes.cuts)} cuts",
        ),
        ("initial points", f"{len(facts.cloud):,}" if facts.cloud else "none"),
    ]
    if facts.stereo:
        rows.insert(4, ("stereo", facts.stereo.reason))
    rows += [(quotation(f"source of {name}"), quotation(text)) for name, text in facts.sources.items()]
    return rows


def as_json(facts: Facts, findings: list[Finding]) -> dict[str, Any]:
    """Facts and findings as JSON values. NaN becomes None.

    Of the initial points only the number is written, of the mask of the border its share of the pixels.
    """
    return {"facts": _plain(facts), "findings": _plain(findings)}


def unit_reason(facts: Facts) -> str:
    """Why the depth has the unit that it seems to have."""
    if facts.depth.known is not None:
        return facts.depth.known.text
    return facts.depth.unit.reason if _unit_is_guessed(facts) else "its scale is unknown or assumed"


def _unit_is_guessed(facts: Facts) -> bool:
    return not (facts.depth.relative or facts.depth.known) or facts.depth.unit.unit == "disparity"


def _camera_words(facts: Facts) -> str:
    if facts.camera_is_fixed:
        return "static in the stored poses"
    path = f"{facts.camera_path_mm:.3g} {length_unit(facts.depth.relative)}"
    return f"moves up to {path} and {facts.camera_turn_deg:.3g} degrees in the stored poses"


def _border_words(facts: Facts) -> str:
    strips, circle = facts.border.strips, facts.border.circle
    words = [f"strip of {size} px at the {name}" for name, size in vars(strips).items() if size]
    words += [f"round, radius {circle.radius:.0f} px"] if circle else []
    if not circle and facts.border.outside.any():
        unsure = ", uncertain" if facts.border.sharpness < CERTAIN else ""
        words.append(f"{facts.border.outside.mean():.1%} of a frame is outside{unsure}")
    masked = float(facts.border.masked.mean())
    words += [f"{masked:.1%} of pixels masked"] if masked else []
    return ", ".join(words) or "none"


def read_findings(path: Path, fix: str) -> tuple[Finding, ...]:
    """The findings in a JSON file that holds what `as_json` gave; they may come from somebody else."""
    return read_parts(path, {"findings": tuple[Finding, ...]}, fix)["findings"]


def _plain(value: Any) -> Any:
    """JSON values of a dataclass, list, array or number."""
    if type(value).__name__ == "PointCloud":
        return {"points": len(value)}
    if is_dataclass(value):
        return {field.name: _plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, dict):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, np.ndarray) and value.dtype == bool:
        return float(value.mean())
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    return str(value) if isinstance(value, Path) else value
