"""Packages that are also functions: `endoprior.export(...)` is `endoprior.export.export(...)`.

A package and a public function may have the same name. So it does not matter which of the two was imported first.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any


def make_callable(package: str, function: Callable[..., Any]) -> None:
    """Let calls of an imported package, given by its whole name, be calls of `function`."""
    signature = inspect.signature(function)

    def call(*values: Any, **options: Any) -> Any:
        try:
            signature.bind(*values, **options)
        except TypeError as error:  # of the name that the caller knows
            raise TypeError(f"{package}({', '.join(signature.parameters)}): {error}") from None
        return function(*values, **options)

    # `inspect.signature` looks at `__wrapped__`.
    members = {"__call__": staticmethod(call), "__wrapped__": staticmethod(function)}
    sys.modules[package].__class__ = type("CallablePackage", (ModuleType,), members)
