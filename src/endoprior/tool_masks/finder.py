"""Find the tools in the frames of one clip.

`network` gives each pixel of a frame the log-odds of a tool; `regions` turns them into masks. Nothing is fitted to the
clip, so a tool that rests in every frame is found as well as one that moves. The masks are a starting point: correct
them in the viewer, or pass your own. `H, W` image size, `h, w` size of the network's image.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from ..core.checks import check_shape
from ..data.found_tools import FoundTools
from ..footage.components import Image, Mask
from .network import LONG_SIDE_PX, MULTIPLE, ToolNetwork, network_input, shipped_network
from .regions import tool_regions

MAYBE = 0.25  # Pixels of a higher probability may be a tool: they count in the confidence
LEAST_DOUBT = 0.004  # Share of the view in doubt from which on a frame without a mask is uncertain


class ToolFinder:
    """Finds the tools of single frames."""

    def __init__(self, network: ToolNetwork | None = None) -> None:
        """Take a network in place of the one that comes with the program."""
        self._network = network or shipped_network()

    def log_odds(self, rgb_u8: Image, view: Mask, mirrored: bool = True) -> NDArray[np.float32]:
        """(h, w) log-odds of a tool of a frame (H, W, 3) in the view (H, W). `mirrored`: mean over the frame and its
        three mirror images, which is steadier and takes four times as long.
        """
        image = torch.from_numpy(network_image(rgb_u8, view))
        h, w = image.shape[1:]
        flips = ((), (-1,), (-2,), (-1, -2)) if mirrored else ((),)
        images = torch.stack([image.flip(flip) for flip in flips])
        images = torch.nn.functional.pad(images, (0, -w % MULTIPLE, 0, -h % MULTIPLE))
        with torch.inference_mode():
            found = self._network(images.contiguous(memory_format=torch.channels_last))[:, :h, :w]
        return torch.stack([one.flip(flip) for one, flip in zip(found, flips, strict=True)]).mean(0).numpy()

    def find(self, rgb_u8: Image, view: Mask) -> FoundTools:
        """Find the tools of one frame; arguments as in `log_odds`."""
        if not view.any():
            return FoundTools(np.zeros_like(view), 1.0)
        probability = 1 / (1 + np.exp(-self.log_odds(rgb_u8, view)))
        small = small_view(view)
        mask = tool_regions(probability * small, small)
        maybe = probability[(mask | (probability > MAYBE)) & small]
        enough = mask.any() or maybe.size > LEAST_DOUBT * small.sum()
        confidence = float(np.abs(2 * maybe - 1).mean()) if enough else 1.0
        return FoundTools(full_size(mask, view.shape) & view, confidence)


def network_size(shape: tuple[int, ...]) -> tuple[int, int]:
    """(w, h) of the network's image for frames of (H, W)."""
    scale = LONG_SIDE_PX / max(shape)
    return max(1, round(shape[1] * scale)), max(1, round(shape[0] * scale))


def network_image(rgb_u8: Image, view: Mask) -> NDArray[np.float32]:
    """(6, h, w) what the network sees of a frame; arguments as in `ToolFinder.log_odds`."""
    check_shape("rgb_u8:H,W,3 view:H,W", rgb_u8=rgb_u8, view=view)
    small = cv2.resize(rgb_u8, network_size(view.shape), interpolation=cv2.INTER_AREA)
    return network_input(np.asarray(small, np.uint8), small_view(view))


def small_view(view: Mask) -> Mask:
    """(h, w) of the view (H, W)."""
    return cv2.resize(view.astype(np.uint8), network_size(view.shape), interpolation=cv2.INTER_NEAREST) > 0


def full_size(mask: Mask, shape: tuple[int, ...]) -> Mask:
    """(H, W) of a mask (h, w)."""
    return cv2.resize(mask.astype(np.float32), shape[::-1], interpolation=cv2.INTER_LINEAR) > 0.5
