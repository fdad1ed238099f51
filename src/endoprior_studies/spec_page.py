"""The page of `endoprior bench NAME --help`: what a spec compares, and the names that its options take."""

from __future__ import annotations

from pathlib import Path
from textwrap import wrap

from endoprior.system.installation import page

from .spec import SequenceSpec, Spec
from .spec_file import load_spec, specs_of

ROOT = "$ENDOPRIOR_DATA/"
"""Paths of sequences that a user has to have begin with it."""
WIDTH = 80


def spec_page(name: str, source: Path) -> str:
    """What the spec of a name, or the specs of its folder, need and take. Args: source: its file or folder."""
    specs = {path: load_spec(path) for path in specs_of(source)}
    own: dict[str, str] = {}
    for spec in specs.values():
        own = {data: _words(spec, data) for data, each in spec.sequences.items() if each.path} | own
    methods = sorted({method for spec in specs.values() for method in spec.methods})
    lines = [f"usage: endoprior bench {name} OUT{' [--data NAME=FOLDER ...]' if own else ''} [options]", ""]
    width = max(len(path.stem) for path in specs)
    for path, spec in specs.items():
        lines += _wrapped(f"  {name}/{path.stem:<{width}}  " if source.is_dir() else "", spec.title)
    if own:
        lines += ["", "names for --data; those that you leave out are looked for in $ENDOPRIOR_DATA:"]
        width = max(map(len, own))
        for data, words in own.items():
            lines += _wrapped(f"  {data:<{width}}  ", words)
    lines += ["", *_wrapped("names for --methods: ", ", ".join(methods))]
    given = " ".join(["--data", *(f"{data}=FOLDER" for data in list(own)[:2])]) if own else "--estimate"
    lines += ["", f"All options: `endoprior bench --help`. The page: {page('benchmarks.md')}"]
    lines += ["", "examples:", f"  endoprior bench {name} OUT {given}"]
    if own:
        lines.append(f"  endoprior bench {name} OUT {given} --estimate")
    return "\n".join(lines)


def _words(spec: Spec, name: str) -> str:
    """What the folder of a sequence is: the data it belongs to, its place there, layout and frames."""
    sequence, about = spec.sequences[name], spec.published
    parts = [f"{about.data}: {_place(sequence)}" if about else _place(sequence)]
    if about and name in about.frames:
        parts.append(f"{about.frames[name]} frames")
    if sequence.format == "scared":
        parts.append("the folder that holds data/")
    elif sequence.format != "auto":
        parts.append(f"layout {sequence.format}")
    if sequence.stride > 1:
        parts.append(f"1 frame of {sequence.stride} is used")
    return ", ".join(parts)


def _place(sequence: SequenceSpec) -> str:
    """The folder as its dataset calls it."""
    known = sequence.path.removeprefix(ROOT)
    return known.partition("/")[2] or f"a sequence folder, {sequence.path}"


def _wrapped(head: str, words: str) -> list[str]:
    return wrap(words, WIDTH, initial_indent=head, subsequent_indent=" " * (len(head) or 2))
