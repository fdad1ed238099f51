"""Lines about the computer itself, and about optional parts."""

from __future__ import annotations

from ..core.extras import install_command
from .lines import Line, State
from .records import Facts, Torch

PARTS = {
    "exr": ("depth in OpenEXR files", ("OpenEXR",)),
    "mono": ("depth by a network", ("transformers",)),
    "networks": ("network scores", ("torchvision", "lpips")),
    "poses": ("camera path by COLMAP", ("pycolmap",)),
    "ray": ("benchmarks on a cluster", ("ray",)),
    "tools": ("tool masks by SAM 2", ("transformers",)),
}
"""Optional part -> what it is for, and what it imports."""
OURS = ("ENDOPRIOR_WEIGHTS", "ENDOPRIOR_CACHE_GB")
"""Variables the program reads."""
TESTS = ("ENDOPRIOR_DATA", "ENDOPRIOR_CHROMIUM", "ENDOPRIOR_HYPOTHESIS", "ENDOPRIOR_TEST_PICTURES")
"""Variables its tests read."""


def machine_lines(facts: Facts) -> list[Line]:
    """The computer, its Python and PyTorch: all that the CPU needs."""
    system = facts.system
    inside = ", in a container" if system.container else ""
    free = "unknown" if system.free_gb is None else f"{system.free_gb:.1f} GB free"
    return [
        Line("machine", "computer", "ok", f"{system.release or system.name}, {system.machine}{inside}"),
        Line("machine", "Python", "ok", system.python),
        Line("machine", "cores", "ok", f"{system.cores}"),
        Line("machine", "memory", "ok", free),
        _pytorch(facts.torch),
    ]


def _pytorch(torch: Torch) -> Line:
    """What the CPU needs of PyTorch; the lines about the GPU ask for more."""
    if not torch.version:
        return Line("machine", "PyTorch", "missing", "not installed", "pip install -c constraints.txt torch")
    if torch.error:
        repair = "pip install --force-reinstall -c constraints.txt torch"
        return Line("machine", "PyTorch", "wrong", f"{torch.version}: {torch.error}", repair)
    return Line("machine", "PyTorch", "ok", torch.version)


def optional_lines(facts: Facts) -> list[Line]:
    """Optional packages, weights and environment variables."""
    lines = []
    for part, (purpose, packages) in PARTS.items():
        absent = [name for name in packages if not facts.packages.get(name)]
        there = ", ".join(f"{name} {facts.packages[name]}" for name in packages if name not in absent)
        state: State = "optional" if absent else "ok"
        found = f"{purpose}: {'no ' + ', '.join(absent) if absent else there}"
        lines.append(Line("also", part, state, found, install_command(part) if absent else ""))
    lines += _weights(facts)
    return lines + _variables(facts)


def _weights(facts: Facts) -> list[Line]:
    if not facts.weights:
        named = "ENDOPRIOR_WEIGHTS" in facts.weights_error
        repair = "unset ENDOPRIOR_WEIGHTS, or name a folder" if named else ""
        return [Line("also", "weights", "wrong" if named else "optional", facts.weights_error or "not checked", repair)]
    found = ", ".join(f"{network} ({place})" for network, place in facts.weights.items() if place)
    absent = ", ".join(network for network, place in facts.weights.items() if not place)
    if not absent:
        return [Line("also", "weights", "ok", found)]
    repair = "set ENDOPRIOR_WEIGHTS to a folder with their files"
    return [Line("also", "weights", "optional", f"network scores: {found}{'; ' * bool(found)}no {absent}", repair)]


def _variables(facts: Facts) -> list[Line]:
    """Variables that are set; our own are wrong if nothing reads them or their value is not a number."""
    lines = []
    for name, value in facts.variables.items():
        found, repair = value or "(empty)", ""
        if name.startswith("ENDOPRIOR_") and name not in (*OURS, *TESTS):
            found, repair = f"{found}: nothing reads it; expected {', '.join(OURS)}", f"unset {name}"
        elif name == "ENDOPRIOR_CACHE_GB" and not _is_number(value):
            found, repair = f"{found}: expected a number of GB", f"unset {name}"
        lines.append(Line("also", name, "wrong" if repair else "ok", found, repair))
    return lines


def _is_number(text: str) -> bool:
    try:
        return float(text) >= 0
    except ValueError:
        return False
