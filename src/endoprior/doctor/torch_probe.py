"""Runs in a process of its own: imports torch, queries CUDA, prints one line of JSON after `MARK`.

A broken torch or driver may crash or hang here, and the CUDA context it makes ends with the process. Triton is tried
last, and the line printed again with what came of it: the first one is left if that crashes or hangs.
"""

from __future__ import annotations

import json
import os
import sys
from typing import Any

from .probe_process import MARK


def main() -> None:
    """Print what torch tells, and an error for what fails."""
    found: dict[str, Any] = {}
    try:
        import torch
    except BaseException as error:  # also SystemExit, from whatever an installation has become
        found["error"] = _words(error)
        return _answer(found)
    found["version"] = str(torch.__version__)
    found["cuda"] = getattr(torch.version, "cuda", None) or ""
    found["hip"] = getattr(torch.version, "hip", None) or ""
    for name, read in (("extensions", _extensions), ("host_compilers", _host_compilers)):
        try:
            found[name] = read()
        except Exception:
            continue
    found.update(_weights())
    found["triton"] = _triton()
    if found["cuda"]:
        found.update(_cuda(torch))
    _answer(found)
    gpus = found.get("gpus")
    if gpus and gpus[0]["computes"] and found["triton"]["version"]:
        found["triton"] |= _triton_computes()
        _answer(found)


def _cuda(torch: Any) -> dict[str, Any]:
    """GPUs, and whether each of them adds two numbers."""
    found: dict[str, Any] = {"available": False, "reason": "", "gpus": [], "architectures": []}
    try:
        found["architectures"] = list(torch.cuda.get_arch_list())
        found["available"] = bool(torch.cuda.is_available())
        if not found["available"]:
            torch.cuda.init()  # says why
            return found
        for index in range(torch.cuda.device_count()):
            found["gpus"].append(_gpu(torch, index))
    except Exception as error:
        found["reason"] = _words(error)
    return found


def _gpu(torch: Any, index: int) -> dict[str, Any]:
    gpu: dict[str, Any] = {"name": f"device {index}", "computes": False, "error": ""}
    try:
        facts = torch.cuda.get_device_properties(index)
        gpu |= {"name": facts.name, "capability": [facts.major, facts.minor], "memory_gb": facts.total_memory / 2**30}
        gpu["computes"] = (torch.ones(2, device=f"cuda:{index}") + 1).sum().item() == 4.0
    except Exception as error:
        gpu["error"] = _words(error)
    return gpu


def _triton() -> dict[str, Any]:
    """Its version, or why it cannot be imported; that it is not installed needs no words."""
    try:
        import triton

        return {"version": str(triton.__version__), "error": ""}
    except BaseException as error:
        absent = isinstance(error, ModuleNotFoundError) and error.name == "triton"
        return {"version": "", "error": "" if absent else _words(error)}


def _triton_computes() -> dict[str, Any]:
    """Whether it compiles for the first GPU, and computes there."""
    try:
        from .triton_probe import adds

        return {"computes": adds("cuda"), "error": ""}
    except BaseException as error:
        return {"computes": False, "error": _words(error)}


def _extensions() -> str:
    """Folder of compiled extensions as torch chooses it, without making it."""
    import torch
    from torch.utils.cpp_extension import get_default_build_root

    if named := os.environ.get("TORCH_EXTENSIONS_DIR"):
        return named
    build = f"cu{torch.version.cuda.replace('.', '')}" if torch.version.cuda else "cpu"
    python = f"py{sys.version_info.major}{sys.version_info.minor}{getattr(sys, 'abiflags', '')}"
    return os.path.join(get_default_build_root(), f"{python}_{build}")


def _host_compilers() -> dict[str, list[int]]:
    """For each nvcc that torch knows: the first gcc that is too new for it."""
    from torch.utils.cpp_extension import CUDA_GCC_VERSIONS

    return {nvcc: [int(part) for part in bounds[1]] for nvcc, bounds in CUDA_GCC_VERSIONS.items()}


def _weights() -> dict[str, Any]:
    """Where the weights of the scoring networks are; downloads nothing."""
    found: dict[str, str] = {}
    try:
        from ..evaluation.metrics import weights

        for files in (weights.RAFT_LARGE, weights.RAFT_SMALL, weights.ALEXNET, weights.SQUEEZENET):
            try:
                place = weights.find_weights(files, download=False)
                found[files.network] = f"{place.path.name} in {place.source}"
            except weights.WeightsMissing:
                found[files.network] = ""
    except Exception as error:
        return {"weights": found, "weights_error": _words(error)}
    return {"weights": found}


def _words(error: BaseException) -> str:
    return " ".join(str(error).split())[:300] or type(error).__name__


def _answer(found: dict[str, Any]) -> None:
    print("\n" + MARK + json.dumps(found), flush=True)


if __name__ == "__main__":
    main()
