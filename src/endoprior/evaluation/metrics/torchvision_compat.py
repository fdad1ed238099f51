"""Import torchvision, also where its compiled operators do not fit the installed torch.

A CUDA build of torchvision with a CPU-only torch cannot load its operators, and its import then fails with "operator
torchvision::nms does not exist" because it registers two of them by name. RAFT and the classifiers use no compiled
operator, so declaring those two names is enough. Only this file and the lpips package import torchvision.
"""

from __future__ import annotations

import importlib
from types import ModuleType
from typing import Any

from ...core.shell import install_command, missing_package
from .weights import ScoreUnavailable

MISSING_OPERATORS = (
    "nms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor",
    "qnms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor",
)
"""Schemas of the operators torchvision describes while it is imported."""

# torch drops the declarations when the library object is garbage-collected.
_declared: list[Any] = []


def import_torchvision() -> ModuleType:
    """The torchvision module, after declaring its missing operators if the import fails for that reason.

    Raises:
        ScoreUnavailable: torchvision is not installed, or does not work with this torch.
    """
    try:
        try:
            return _import_torchvision()
        except RuntimeError as error:
            if "operator torchvision::" not in str(error):
                raise
        _declare_operators()
        return _import_torchvision()
    except ImportError as error:
        raise ScoreUnavailable(missing_package("torchvision", "networks", error)) from error
    except RuntimeError as error:
        raise _broken(error) from error


def _import_torchvision() -> ModuleType:
    """The torchvision module with the parts used here; RuntimeError if it does not match torch."""
    importlib.import_module("torchvision.models.optical_flow")
    return importlib.import_module("torchvision")


def _declare_operators() -> None:
    """Declare to torch the operators torchvision could not load; calling them still fails."""
    import torch

    if not _declared:
        library = torch.library.Library("torchvision", "DEF")
        for schema in MISSING_OPERATORS:
            library.define(schema)
        _declared.append(library)


def _broken(error: RuntimeError) -> ScoreUnavailable:
    """The reason to report for a torchvision that does not work with this torch."""
    import torch

    cause = str(error).strip().splitlines()[0]
    return ScoreUnavailable(
        f"torchvision does not work beside torch {torch.__version__} ({cause}). Fix: `{install_command('networks')}`."
    )
