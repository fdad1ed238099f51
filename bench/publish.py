"""Put the report of one spec into the documentation: its text and values, and its figures as small JPEG files.

`python bench/publish.py OUT NAME`, after `endoprior bench sized/NAME OUT`, writes docs/results/NAME.md and NAME.csv and
docs/images/results/NAME-*.jpg. docs/results.md says in words what follows from them.
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


def publish(report: Path, name: str, docs: Path = DOCS) -> None:
    """Copy results.md, results.csv and the figures of a `report` to `docs`; older ones of this name are replaced."""
    folder, images = docs / "results", docs / "images" / "results"
    for place in (folder, images):
        place.mkdir(parents=True, exist_ok=True)
    for old in images.glob(f"{name}-*.jpg"):
        old.unlink()

    def converted(link: re.Match[str]) -> str:
        image = cv2.imread(str(report / link[2]))
        factor = min(1.0, WIDTH_PX / image.shape[1])
        small = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
        file = f"{name}-{Path(link[2]).stem}.jpg"
        cv2.imwrite(str(images / file), small, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        return f"![{link[1]}](../images/results/{file})"

    text = FIGURE.sub(converted, (report / "results.md").read_text(encoding="utf-8"))
    (folder / f"{name}.md").write_text(text, encoding="utf-8")
    shutil.copyfile(report / "results.csv", folder / f"{name}.csv")


if __name__ == "__main__":
    publish(Path(sys.argv[1]), sys.argv[2])
