"""Export: a trained scene in formats that other programs read. Each format is a module; `formats` lists them all."""

from ..core.callable_package import make_callable
from .exporting import export
from .formats import ExportOptions

__all__ = ["ExportOptions", "export"]

make_callable(__name__, export)
