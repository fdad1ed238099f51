"""Put the overview of a benchmark into the documentation: its text, and its figures as small JPEG files.

`python bench/publish.py OUT`, after `endoprior bench sized OUT`, writes docs/results.md and
docs/images/results/.
"""

from __future__ import annotations

import re
import shutil
import sys
from pathlib import Path

import cv2

DOCS = Path(__file__).parents[1] / "docs"
WIDTH_PX = 1300
JPEG_QUALITY = 82
FIGURE = re.compile(r"!\[([^]]+)\]\(([^)]+)\)")


def publish(out: Path, docs: Path = DOCS) -> None:
    """Copy `out`/results.md and the figures it links to `docs`; older figures are removed."""
    folder = docs / "images" / "results"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)

    def converted(link: re.Match[str]) -> str:
        image = cv2.imread(str(out / link[2]))
        factor = min(1.0, WIDTH_PX / image.shape[1])
        small = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
        name = "-".join(part for part in Path(link[2]).with_suffix(".jpg").parts if part != "figures")
        cv2.imwrite(str(folder / name), small, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        return f"![{link[1]}](images/results/{name})"

    text = FIGURE.sub(converted, (out / "results.md").read_text(encoding="utf-8"))
    (docs / "results.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    publish(Path(sys.argv[1]))
