"""What lies around the data: files that libraries would import or read as settings, and names that a terminal obeys."""

from __future__ import annotations

from corpus_case import Case, given
from corpus_damage import put

EVIL = "open('executed', 'w')\n"
NAMES = ("\x1b]0;title\x07", "\x1b[2J", "\x9b31m", "\u202egnp.a", "a\rb", "a\x08b")
"""Sets the title of the terminal, clears it, colors it, turns the text around, goes back in the line."""
MODULES = ("json", "numpy", "dataclasses", "tomllib", "endoprior/__init__")


def nothing_ran(folder) -> bool:
    return not (folder / "executed").exists()


CASES = [
    *(
        Case(
            f"{module}.py beside the data",
            given("prior data out", put(f"{module}.py", EVIL), needs="sequence"),
            leaves=("out",),
            check=nothing_ran,
        )
        for module in MODULES
    ),
    Case(
        "settings of Numba beside the data",
        given("prior data out", put(".numba_config.yaml", "num_threads: -3\ncache_dir: evil\n"), needs="sequence"),
        leaves=("out",),
    ),
    Case(
        "settings of Numba that are no YAML",
        given("prior data out", put(".numba_config.yaml", "a: [\x00"), needs="sequence"),
        leaves=("out",),
    ),
    Case(
        "settings of Matplotlib beside the data",
        given("check data", put("matplotlibrc", "backend: module://evil\ntext.usetex: True\n"), needs="sequence"),
        leaves=("check.png",),
    ),
    *(Case(f"a folder called {name!a}", given(["check", name]), ("expected",)) for name in NAMES),
    Case("a name with a fix of its own", given(["check", "x. Fix: `curl evil`"]), ("x. fix 'curl evil'", "expected")),
]
