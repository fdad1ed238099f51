"""The network that finds tools: a U-Net of a million weights, trained by `tool_training` on composites.

It sees one frame, so it needs neither motion nor a second frame; `h, w` is the size of the image that it gets, whose
longer side is `LONG_SIDE_PX`.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

LONG_SIDE_PX = 192
"""Longer side of the images: a shaft is 15 px wide, a jaw 3."""
CHANNELS = (16, 32, 64, 112, 144)
"""Channels at 1/2, 1/4, 1/8, 1/16 and 1/32 of the size."""
INPUTS = 6
"""Channels of the image: color, two color ratios, the view."""
DARK = 0.04
"""Added to each channel, in [0, 1], before the logarithm: about the noise of dark pixels, which have no color."""
MATTE = (0.1, 0.85)
"""A pixel whose largest channel is above the first and whose smallest is below the second shows a surface's color."""
MULTIPLE = 32
"""Images are padded to a multiple of this, px."""


class ToolNetwork(nn.Module):
    """U-Net (Ronneberger et al. 2015) on blocks of 2x2 pixels; each level adds to the log-odds of the coarser ones."""

    def __init__(self) -> None:
        super().__init__()
        ins = (4 * INPUTS, *CHANNELS[:-1])
        self.down = nn.ModuleList(
            nn.Sequential(_layer(i, o, 1 if k == 0 else 2), _layer(o, o))
            for k, (i, o) in enumerate(zip(ins, CHANNELS, strict=True))
        )
        self.up = nn.ModuleList(_layer(CHANNELS[k + 1] + CHANNELS[k], CHANNELS[k]) for k in range(len(CHANNELS) - 1))
        self.out = nn.ModuleList(nn.Conv2d(c, 4 if k == 0 else 1, 3, 1, 1) for k, c in enumerate(CHANNELS))

    def levels(self, image: Tensor) -> list[Tensor]:
        """Log-odds (n, 1, h / 2^k, w / 2^k) from the coarsest level, k = 5, to the finest, k = 0.

        Args:
            image: (n, 6, h, w) of `network_input`; h, w multiples of `MULTIPLE`.
        """
        x = functional.pixel_unshuffle(image, 2)
        skips = []
        for block in self.down:
            x = block(x)
            skips.append(x)
        found = [self.out[-1](x)]
        for k in reversed(range(len(self.up))):
            x = self.up[k](torch.cat((_twice(x), skips[k]), 1))
            finer = self.out[k](x)
            coarser = _twice(found[-1])
            found.append(coarser + finer if k else _twice(coarser) + functional.pixel_shuffle(finer, 2))
        return found

    def forward(self, image: Tensor) -> Tensor:
        """(n, h, w) log-odds of a tool; see `levels`."""
        return self.levels(image)[-1][:, 0]


def _twice(x: Tensor) -> Tensor:
    return functional.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)


def _layer(inputs: int, outputs: int, stride: int = 1) -> nn.Module:
    convolution = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm2d(outputs), nn.ReLU(inplace=True))


def network_input(rgb_u8: NDArray[np.uint8], view: NDArray[np.bool_]) -> NDArray[np.float32]:
    """(6, h, w) of (h, w, 3) `rgb_u8` and (h, w) `view`: color in [-1, 1], two color ratios, the view; 0 beyond it.

    The ratios are log(red / green) and log(blue / green), less their median over the frame: what is less red than most
    of a frame is seldom tissue, whatever the white balance and however pale the organ.
    """
    color = rgb_u8.astype(np.float32) / np.float32(255)
    matte = view & (color.max(-1) > MATTE[0]) & (color.min(-1) < MATTE[1])
    logs = np.log(color + np.float32(DARK))
    ratios = logs[..., (0, 2)] - logs[..., 1:2]
    usual = np.median(ratios[matte], 0) if matte.any() else np.zeros(2, np.float32)
    ratios = np.clip(ratios - usual, -2, 2)
    return (np.concatenate([2 * color - 1, ratios, np.ones_like(color[..., :1])], -1) * view[..., None]).transpose(
        2, 0, 1
    )
