"""Save figures of Matplotlib, quickly: a first look has three of them, and each would take a second or two."""

from __future__ import annotations

from pathlib import Path

from matplotlib.figure import Figure

from ..system.atomic import whole_file


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure with a layout engine as a PNG file, completely or not at all.

    Matplotlib draws such a figure twice to save it, first only for its layout, which needs no drawing.
    """
    if (layout := figure.get_layout_engine()) is not None:
        layout.execute(figure)
        figure.set_layout_engine("none")
    with whole_file(path) as temporary:
        figure.savefig(temporary, format="png", pil_kwargs={"compress_level": 1})
