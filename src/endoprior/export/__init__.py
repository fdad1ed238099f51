"""Export: a trained scene in formats that other programs read. Each format is a module; `formats` lists them all."""

from .exporting import export
from .formats import ExportOptions

__all__ = ["ExportOptions", "export"]
