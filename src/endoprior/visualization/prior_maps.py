"""Write the cue maps and the joint texture prior of a sequence as images."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.types import to_uint8
from ..data import FrameSequence, Split
from ..priors import joint_texture_prior, salience, specular_likelihood
from ..system.atomic import reject_occupied, whole_folder
from .image_tools import colorize, gray, label, scaled, tile, write_png

SHEET_FRAMES, SHEET_WIDTH_PX = 6, 320


def write_prior_maps(sequence: FrameSequence, split: Split, out: Path) -> Path:
    """Write `specular/`, `salience/` and `prior/` (gray, 255 = 1) and `contact_sheet.png` into `out`.

    Returns:
        Path of the contact sheet.
    Raises:
        InputError: `out` exists and is not empty.
    """
    reject_occupied(out)
    frames, rows = sequence.frames(split), list[NDArray[np.uint8]]()
    shown = np.linspace(0, len(frames) - 1, min(SHEET_FRAMES, len(frames))).astype(int)
    with whole_folder(out) as folder:
        for position, frame in enumerate(frames):
            maps = {
                "specular": specular_likelihood(frame.rgb),
                "salience": salience(frame.rgb, frame.tissue_mask),
                "prior": joint_texture_prior(frame.rgb, frame.tissue_mask),
            }
            for name, values in maps.items():
                write_png(folder / name / f"{frame.index:06d}.png", to_uint8(values))
            if position in shown:
                images = {f"frame {frame.index}": frame.rgb_u8, "tissue mask": gray(frame.tissue_mask)}
                images |= {name: colorize(values, 0, 1) for name, values in maps.items()}
                rows += [label(scaled(image, SHEET_WIDTH_PX), name) for name, image in images.items()]
        write_png(folder / "contact_sheet.png", tile(rows, 5))
    return out / "contact_sheet.png"
