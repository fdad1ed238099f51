"""Options that a method does not use: rejected before a training starts, so that none is ignored silently."""

from __future__ import annotations

from typing import Any

from ..core.checks import input_error
from ..core.config import Config
from ..model.method import method_of
from .radiance_method import RadianceMethod


def reject_ignored_options(cfg: Config) -> None:
    """Reject a value that has no effect with the method of a config.

    Raises:
        InputError: names the option, and the only value that its method takes.
    """
    method = method_of(cfg)
    only: dict[str, Any] = {}
    if isinstance(method, RadianceMethod):
        only = {"data.eyes": "left"}
    elif method.has_gaussians and not method.uses_prior:
        only = {"temporal.weight": 0.0}  # the term weighs Gaussians by the prior
    for name, value in only.items():
        section, _, field = name.partition(".")
        got = getattr(getattr(cfg, section), field)
        if got != value:
            fix = f"Start from --preset {cfg.method}, without --{name.replace('_', '-')}."
            raise input_error(name, f"{value} with method {cfg.method}, which does not use it", str(got), fix)


def note_on_budget(cfg: Config) -> str | None:
    """A line for the user if `init.budget` was set and has no effect; not an error, as benchmark specs set it."""
    method = method_of(cfg)
    if (method.has_gaussians and not method.first_share) or cfg.init.budget == method.config().init.budget:
        return None
    start = "starts from the pixels of frames" if method.has_gaussians else "has no Gaussians"
    return f"init.budget {cfg.init.budget} (--gaussians) has no effect: {cfg.method} {start}"
