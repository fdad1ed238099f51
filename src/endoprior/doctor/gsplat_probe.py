"""Runs in a process of its own: loads gsplat's compiled code, or has gsplat compile it; prints JSON after `MARK`.

Arguments: `load NAME FILE` loads a file that is there and compiles nothing; `compile` does what gsplat does at its
first use, then renders one Gaussian.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import sys
import time as clock
from typing import Any

from .probe_process import MARK

NEEDED = "intersect_tile"
"""A function that the extension of every version we accept has."""


def main(arguments: list[str]) -> None:
    """Print whether the extension works, and why not."""
    found: dict[str, Any] = {"loads": False, "error": ""}
    try:
        if arguments[0] == "load":
            extension = _load(*arguments[1:3])
        else:
            began = clock.perf_counter()
            extension = importlib.import_module("gsplat.cuda._backend")._C
            found["seconds"] = clock.perf_counter() - began
        if not hasattr(extension, NEEDED):  # gsplat sets None where it finds no toolkit
            found["error"] = "gsplat has no compiled code" if extension is None else f"it has no {NEEDED}"
        else:
            if arguments[0] == "compile":
                _render()
            found["loads"] = True
    except BaseException as error:
        found["error"] = " ".join(str(error).split())[-600:] or type(error).__name__
    print("\n" + MARK + json.dumps(found), flush=True)


def _load(name: str, file: str) -> Any:
    """The extension in `file`, whose functions torch's libraries must be there for."""
    importlib.import_module("torch")
    spec = importlib.util.spec_from_file_location(name, file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _render() -> None:
    """One Gaussian of half opacity in the middle of 16 x 16 pixels; raises if it is not visible."""
    torch = importlib.import_module("torch")
    if not torch.cuda.is_available():  # compiled for another machine
        return
    to = {"device": "cuda", "dtype": torch.float32}
    camera = torch.tensor([[16.0, 0, 8], [0, 16, 8], [0, 0, 1]], **to)
    color, _, _ = importlib.import_module("gsplat").rasterization(
        means=torch.tensor([[0.0, 0, 4]], **to),
        quats=torch.tensor([[1.0, 0, 0, 0]], **to),
        scales=torch.full((1, 3), 0.5, **to),
        opacities=torch.full((1,), 0.5, **to),
        colors=torch.ones(1, 3, **to),
        viewmats=torch.eye(4, **to)[None],
        Ks=camera[None],
        width=16,
        height=16,
        packed=False,
    )
    brightest = color.max().item()
    if not 0.3 < brightest <= 0.5:
        raise RuntimeError(f"it renders a Gaussian of opacity 0.5 with brightness {brightest:.3g}")


if __name__ == "__main__":
    main(sys.argv[1:])
