"""The methods that can be trained, by name. To add one, write its file and add its line here: docs/add_a_method.md.

A method's file is imported when the method is used, so this table may name files of any layer.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..model.method import Method

OWN = "endoprior"
"""Our own method, whose presets are in `presets.py`."""

METHODS = {
    OWN: "endoprior.methods.own",
    "deform3dgs": "endoprior.methods.deform3dgs",
    "endogs": "endoprior.methods.endogs",
    "endo4dgs": "endoprior.methods.endo4dgs",
    "surgicalgaussian": "endoprior.methods.surgicalgaussian",
    "endonerf": "endoprior.methods.endonerf",
    "endosurf": "endoprior.methods.endosurf",
}
"""Module of each method; its object is called `METHOD` there. The name is that of its preset, too."""


def method_named(name: str) -> Method:
    """The method of a name in `METHODS`."""
    return import_module(METHODS[name]).METHOD
