"""Put the report of one spec into the documentation: its values, and the figures that are named as small JPEG files.

`python bench/publish.py OUT NAME FIGURE ...`, after `endoprior bench sized/NAME OUT`, writes docs/results/NAME.csv, and
docs/images/results/NAME-FIGURE.jpg for each FIGURE of OUT/figures (such as sides-clip). docs/results.md has the tables
that matter, says what follows, and shows the figures.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import cv2

DOCS = Path(__file__).parents[1] / "docs"
WIDTH_PX = 1300
JPEG_QUALITY = 82


def publish(report: Path, name: str, figures: tuple[str, ...] = (), docs: Path = DOCS) -> None:
    """Copy results.csv and the `figures` of a `report` to `docs`; older figures of this name are removed."""
    values, images = docs / "results", docs / "images" / "results"
    for place in (values, images):
        place.mkdir(parents=True, exist_ok=True)
    for old in images.glob(f"{name}-*.jpg"):
        old.unlink()
    for figure in figures:
        image = cv2.imread(str(report / "figures" / f"{figure}.png"))
        factor = min(1.0, WIDTH_PX / image.shape[1])
        small = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(images / f"{name}-{figure}.jpg"), small, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    shutil.copyfile(report / "results.csv", values / f"{name}.csv")


if __name__ == "__main__":
    publish(Path(sys.argv[1]), sys.argv[2], tuple(sys.argv[3:]))
