"""Packages that are also functions: `endoprior.export(...)` is `endoprior.export.export(...)`.

A package and a public function may have the same name. So it does not matter which of the two was imported first.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any


def make_callable(package: str, function: Callable[..., Any]) -> None:
    """Let calls of an imported package, given by its whole name, be calls of `function`."""
    call = staticmethod(function)
    members = {"__call__": call, "__wrapped__": call}  # the latter is where `inspect.signature` looks
    sys.modules[package].__class__ = type("CallablePackage", (ModuleType,), members)
