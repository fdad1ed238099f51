"""The network that finds tools: a U-Net on a pretrained way down, trained by `tool_training` on composites.

It sees one frame, so it needs neither motion nor a second frame; `h, w` is the size of the image that it gets, whose
longer side is `LONG_SIDE_PX`. Its weights are a file in the package, checked against its digest; docs/tool_network.md
says how they were made. Nothing is fitted to a clip: a tool that rests is found as well as one that moves. `H, W` is
the size of the whole image.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import load, save
from torch import Tensor, nn
from torch.nn import functional

from ..core.checks import check_shape, shipped_file
from ..footage.image_operations import Image, Mask

FILE = Path(__file__).with_name("tool_network.safetensors")
SHA256 = "354f24d519af9bd2c7d48540de993a97c7b66a17e932575d7cdd99939c1d1cde"
"""Of the file; a test compares it with the file and with the model card."""
LONG_SIDE_PX = 192  # Longer side of the images: a shaft is 15 px wide, a jaw 3
INPUTS = 6  # Channels of the image: color, two color ratios, the view
LOG_COLOR_OFFSET = 0.04
"""Added to each channel, in [0, 1], before the logarithm: about the noise of dark pixels, which have no color."""
MATTE = (0.1, 0.85)
"""A pixel whose largest channel is above the first and whose smallest is below the second shows a surface's color."""
MULTIPLE = 32  # Images are padded to a multiple of this, px


@dataclass(frozen=True)
class Block:
    """The shape of one block."""

    outputs: int
    kernel: int
    stride: int = 1
    widen: int = 6


STEM = 32
STAGES = (
    (Block(16, 3, widen=1),),
    (Block(24, 3, 2), Block(24, 3)),
    (Block(40, 5, 2), Block(40, 5)),
    (*(Block(80, 3, 2), Block(80, 3), Block(80, 3)), *(Block(112, 5),) * 3),
    (Block(192, 5, 2), Block(192, 5)),
)
"""The way down, at 1/2, 1/4, 1/8, 1/16 and 1/32 of the size; EfficientNet-Lite0 goes on with 192 and 320 channels."""
WIDTHS = (24, 32, 48, 72, 192)  # Channels of the way up, at the same sizes


class ToolNetwork(nn.Module):
    """U-Net (Ronneberger et al. 2015) whose way down is the first blocks of EfficientNet-Lite0 (Tan and Le 2019); each
    level of the way up adds to the log-odds of the coarser ones.
    """

    def __init__(self) -> None:
        super().__init__()
        self.stem = _convolution(INPUTS, STEM, 3, stride=2)
        self.down, inputs = nn.ModuleList(), STEM
        for blocks in STAGES:
            stage = nn.Sequential()
            for block in blocks:
                stage.append(InvertedResidual(inputs, block))
                inputs = block.outputs
            self.down.append(stage)
        skips = [blocks[-1].outputs for blocks in STAGES]
        self.up = nn.ModuleList(_convolution(WIDTHS[k + 1] + skips[k], WIDTHS[k], 3) for k in range(len(skips) - 1))
        self.out = nn.ModuleList(nn.Conv2d(c, 4 if k == 0 else 1, 3, 1, 1) for k, c in enumerate(WIDTHS))

    def levels(self, image: Tensor) -> list[Tensor]:
        """Log-odds (n, 1, h / 2^k, w / 2^k) from the coarsest level, k = 5, to the finest, k = 0, of (n, 6, h, w)
        `network_input`; h, w are multiples of `MULTIPLE`.
        """
        x = self.stem(image)
        skips = []
        for stage in self.down:
            x = stage(x)
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


class InvertedResidual(nn.Module):
    """Widen, filter each channel, narrow (Sandler et al. 2018)."""

    def __init__(self, inputs: int, block: Block) -> None:
        super().__init__()
        wide = inputs * block.widen
        self.expand = _convolution(inputs, wide, 1) if block.widen > 1 else nn.Identity()
        self.filter = _convolution(wide, wide, block.kernel, stride=block.stride, groups=wide)
        self.project = nn.Sequential(nn.Conv2d(wide, block.outputs, 1, bias=False), _norm(block.outputs))
        self.adds = block.stride == 1 and inputs == block.outputs

    def forward(self, x: Tensor) -> Tensor:
        """(n, outputs, h / stride, w / stride) of (n, inputs, h, w)."""
        y = self.project(self.filter(self.expand(x)))
        return x + y if self.adds else y


def _twice(x: Tensor) -> Tensor:
    return functional.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)


def _convolution(inputs: int, outputs: int, kernel: int, stride: int = 1, groups: int = 1) -> nn.Sequential:
    """Convolution, normalization, ReLU6. With stride 2 the borders are TensorFlow's, as the pretrained weights ask."""
    before = (kernel - stride) // 2
    after = kernel - stride - before
    pad = nn.ZeroPad2d((before, after, before, after))
    convolution = nn.Conv2d(inputs, outputs, kernel, stride, groups=groups, bias=False)
    return nn.Sequential(pad, convolution, _norm(outputs), nn.ReLU6(inplace=True))


def _norm(channels: int) -> nn.BatchNorm2d:
    return nn.BatchNorm2d(channels, eps=1e-3)


def network_input(rgb_u8: Image, view: Mask) -> NDArray[np.float32]:
    """(6, h, w) of (h, w, 3) `rgb_u8` and (h, w) `view`: color in [-1, 1], two color ratios, the view; 0 beyond it.

    The ratios are log(red / green) and log(blue / green), less their median over the frame: what is less red than most
    of a frame is seldom tissue, whatever the white balance and however pale the organ.
    """
    color = rgb_u8.astype(np.float32) / np.float32(255)
    matte = view & (color.max(-1) > MATTE[0]) & (color.min(-1) < MATTE[1])
    logs = np.log(color + np.float32(LOG_COLOR_OFFSET))
    ratios = logs[..., (0, 2)] - logs[..., 1:2]
    usual = np.median(ratios[matte], 0) if matte.any() else np.zeros(2, np.float32)
    ratios = np.clip(ratios - usual, -2, 2)
    channels = np.concatenate([2 * color - 1, ratios, np.ones_like(color[..., :1])], -1) * view[..., None]
    return channels.transpose(2, 0, 1)


@cache
def shipped_network() -> ToolNetwork:
    """The network that comes with the program, for inference only; InputError if the file is missing or changed."""
    return network_from(shipped_file(FILE, SHA256, "the weights of the tool network"))


def network_from(data: bytes) -> ToolNetwork:
    """A network for inference from the bytes of a weights file."""
    network = ToolNetwork()
    counters = {name: value for name, value in network.state_dict().items() if not value.is_floating_point()}
    network.load_state_dict(counters | {name: value.float() for name, value in load(data).items()})
    network.eval().requires_grad_(False)
    return network.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]: missing in the stubs


def weights_of(network: ToolNetwork) -> bytes:
    """The bytes of a weights file: every weight in float16, without counters."""
    state = network.state_dict()
    return save({name: value.half().contiguous() for name, value in state.items() if value.is_floating_point()})


def network_size(shape: tuple[int, ...]) -> tuple[int, int]:
    """(w, h) of the network's image for frames of (H, W)."""
    scale = LONG_SIDE_PX / max(shape)
    return max(1, round(shape[1] * scale)), max(1, round(shape[0] * scale))


def network_image(rgb_u8: Image, view: Mask) -> NDArray[np.float32]:
    """(6, h, w) what the network sees of a frame; arguments as in `ToolFinder.log_odds` of `tool_finder`."""
    check_shape("rgb_u8:H,W,3 view:H,W", rgb_u8=rgb_u8, view=view)
    small = cv2.resize(rgb_u8, network_size(view.shape), interpolation=cv2.INTER_AREA)
    return network_input(np.asarray(small, np.uint8), small_view(view))


def small_view(view: Mask) -> Mask:
    """(h, w) of the view (H, W)."""
    return cv2.resize(view.astype(np.uint8), network_size(view.shape), interpolation=cv2.INTER_NEAREST) > 0


def full_size(mask: Mask, shape: tuple[int, ...]) -> Mask:
    """(H, W) of a mask (h, w)."""
    return cv2.resize(mask.astype(np.float32), shape[::-1], interpolation=cv2.INTER_LINEAR) > 0.5
