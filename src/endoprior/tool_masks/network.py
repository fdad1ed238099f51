"""A small network that is trained anew for each clip: on its own frames, with painted instruments.

Where the first guess is sure of tissue, a frame shows what is not a tool in this clip: its organs, its light, its
highlights. What a tool looks like comes from the painted instruments. Pixels of which the first guess is not sure,
such as those of the real tools, do not count. So no labels are needed, no weights are shipped, and pale organs of the
clip at hand are learned as tissue. Examples are lit anew, so that overexposed tissue is known too.
If there are masks to start from, their tools count too.

The network is a U-Net of 100,000 weights on images of 192 px. `h, w` size of such an image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from .colors import ClipColors, log_ratios
from .lighting import exposed, overexposed
from .synthetic import paint_tool

LONG_SIDE_PX = 192
"""Longer side of the images: a shaft is 15 px wide, a jaw 3."""
CHANNELS = (20, 28, 36, 36)
"""Channels at 1/2, 1/4, 1/8 and 1/16 of the size."""
BATCH = 8
EXAMPLES_PER_STEP = 0.8
"""Examples painted for each step: each is seen ten times, mirrored or not."""
TOOLS = (0.1, 0.5, 0.4)
"""Probability of none, one and two instruments in an example."""
RATE = 8e-3
"""Highest learning rate of the one-cycle schedule (Smith and Topin 2019)."""


@dataclass(frozen=True)
class Background:
    """One frame of the clip that examples are painted into."""

    rgb: NDArray[np.float32]
    """(h, w, 3), where 1 is the clip's white."""
    view: NDArray[np.bool_]
    """(h, w) True inside the endoscope's image."""
    tissue: NDArray[np.bool_]
    """(h, w) True where it surely shows tissue."""
    tools: NDArray[np.bool_]
    """(h, w) True where it surely shows a tool: masks that the user gave."""


class ToolNetwork(nn.Module):
    """U-Net (Ronneberger et al. 2015) that works on blocks of 2x2 pixels."""

    def __init__(self) -> None:
        super().__init__()
        full, half, quarter, least = CHANNELS
        self.down0 = _layer(4 * 4, full)
        self.down1 = _layer(full, half, 2)
        self.down2 = nn.Sequential(_layer(half, quarter, 2), _layer(quarter, quarter))
        self.down3 = nn.Sequential(_layer(quarter, least, 2), _layer(least, least))
        self.up2 = _layer(least + quarter, quarter)
        self.up1 = _layer(quarter + half, half)
        self.up0 = _layer(half + full, 16)
        self.out = nn.Conv2d(16, 4, 3, 1, 1)

    def forward(self, image: Tensor) -> Tensor:
        """(n, h, w) log-odds of a tool for (n, 4, h, w) images of `network_input`."""
        h, w = image.shape[2:]
        image = functional.pad(image, (0, -w % 16, 0, -h % 16))
        a = self.down0(functional.pixel_unshuffle(image, 2))
        b = self.down1(a)
        c = self.down2(b)
        x = self.up2(_joined(self.down3(c), c))
        x = self.up0(_joined(self.up1(_joined(x, b)), a))
        return functional.pixel_shuffle(self.out(x), 2)[:, 0, :h, :w]


def _layer(inputs: int, outputs: int, stride: int = 1) -> nn.Module:
    convolution = nn.Conv2d(inputs, outputs, 3, stride, 1)
    return nn.Sequential(convolution, nn.GroupNorm(4, outputs), nn.ReLU(inplace=True))


def _joined(low: Tensor, high: Tensor) -> Tensor:
    """`low`, enlarged to the size of `high`, and `high`."""
    return torch.cat([functional.interpolate(low, size=high.shape[2:], mode="nearest"), high], 1)


def network_input(rgb: NDArray[np.float32], view: NDArray[np.bool_], clip: ClipColors) -> NDArray[np.float32]:
    """(4, h, w): redness and blueness in units of the clip, brightness, view."""
    red, blue = log_ratios(rgb)
    tone = 2 * np.sqrt(np.maximum(rgb.mean(-1), 0)) - 1
    channels = [red / clip.redness, (blue - clip.blueness) / clip.chroma, tone, np.ones_like(red)]
    return (np.stack(channels) * view).astype(np.float32)


def train_network(backgrounds: Sequence[Background], clip: ClipColors, steps: int, seed: int = 0) -> ToolNetwork:
    """Train on painted examples; equal arguments give equal weights.

    Args:
        backgrounds: of one size, each with a view that is not empty.
    """
    rng = np.random.default_rng(seed)
    examples = [_example(rng, backgrounds, clip) for _ in range(max(BATCH, round(EXAMPLES_PER_STEP * steps)))]
    images, tools, counted = (torch.from_numpy(np.stack(part)) for part in zip(*examples, strict=True))
    with torch.random.fork_rng(devices=[]), torch.enable_grad():
        torch.manual_seed(seed)
        network = ToolNetwork().to(memory_format=torch.channels_last)
        optimizer = torch.optim.AdamW(network.parameters(), weight_decay=1e-4)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, total_steps=steps)
        for _ in range(steps):
            batch = torch.from_numpy(rng.integers(0, len(images), BATCH))
            log_odds = network(images[batch].contiguous(memory_format=torch.channels_last))
            losses = functional.binary_cross_entropy_with_logits(log_odds, tools[batch], reduction="none")
            loss = (losses * counted[batch]).sum() / counted[batch].sum().clamp(min=1)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
    return network.requires_grad_(False)


def _example(
    rng: np.random.Generator, backgrounds: Sequence[Background], clip: ClipColors
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """(4, h, w) image, (h, w) 1 on instruments, (h, w) 1 where the loss counts."""
    background = backgrounds[rng.integers(len(backgrounds))]
    rgb, tool = exposed(rng, background.rgb), background.tools.copy()
    for _ in range(rng.choice(3, p=TOOLS)):
        rgb, painted = paint_tool(rng, rgb, background.view)
        tool |= painted
    counted = background.view & (tool | background.tissue)
    parts = network_input(overexposed(rng, rgb), background.view, clip), tool, counted
    if rng.random() < 0.5:
        parts = tuple(part[..., ::-1] for part in parts)
    image, tool, counted = (np.ascontiguousarray(part, np.float32) for part in parts)
    return image, tool, counted


def log_odds_of(
    network: ToolNetwork, rgb: NDArray[np.float32], view: NDArray[np.bool_], clip: ClipColors
) -> NDArray[np.float32]:
    """(h, w) log-odds of a tool in one frame.

    Args:
        rgb: (h, w, 3), where 1 is the clip's white.
        view: (h, w).
    """
    with torch.no_grad():
        return network(torch.from_numpy(network_input(rgb, view, clip))[None])[0].numpy()


def network_size(size: tuple[int, int]) -> tuple[int, int]:
    """(width, height) at which the network sees an image of `size`."""
    scale = LONG_SIDE_PX / max(size)
    return max(1, round(size[0] * scale)), max(1, round(size[1] * scale))


def shrunk(array: NDArray, size: tuple[int, int]) -> NDArray:
    """`array` (H, W) or (H, W, 3), averaged down to `size` (width, height)."""
    return cv2.resize(array, size, interpolation=cv2.INTER_AREA)
