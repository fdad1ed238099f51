"""LPIPS (Zhang et al. 2018): the distance of two images in the features of a classifier, through the lpips package.

`lpips` means AlexNet, as published; the same distance with SqueezeNet is scored as `lpips_squeeze`. VGG16 and images in
[0, 1] are for the protocols of other papers. The package contains the calibrated heads.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from ...core.shell import missing_package
from ...footage.image_operations import Mask
from ..context import NETWORKS_OFF, EvaluationContext
from ..networks import (
    ALEXNET,
    SQUEEZENET,
    VGG16,
    WeightFiles,
    find_weights,
    import_torchvision,
    load_weights,
    select_weights,
)
from ..score import Score, ScoreUnavailable
from .image import check_images

if TYPE_CHECKING:
    from torch.nn import Module

HEADS_VERSION = "0.1"  # Version of the calibrated heads: the one every published LPIPS figure uses
Backbone = Literal["alex", "squeeze", "vgg"]
CLASSIFIERS: dict[Backbone, WeightFiles] = {"alex": ALEXNET, "squeeze": SQUEEZENET, "vgg": VGG16}
MIN_SIZE = 32  # Shortest side, px: much below it the deepest features have no pixel left
SCORES = (
    Score(
        "lpips", "LPIPS", "", False, 4,
        "The published one: perceptual distance of the masked images by AlexNet; needs its weights.",
        group="image", hint="0 is identical",
    ),
    Score(
        "lpips_squeeze", "LPIPS (squeeze)", "", False, 4,
        "The same by SqueezeNet, where its weights are on this machine.",
        group="image", in_summary=False, stands_for="lpips",
    ),
)  # fmt: skip


def compute(context: EvaluationContext) -> None:
    """Score every frame of the split with each network whose weights are there."""
    if not context.networks:
        context.skip("lpips", NETWORKS_OFF)
        return
    with context.skip_if_unavailable("lpips"):
        _add(context, "lpips", lpips_distance("alex", context.weights_dir, download=context.download))
    if squeeze := squeeze_distance(context, "lpips_squeeze"):
        with context.skip_if_unavailable("lpips_squeeze"):
            _add(context, "lpips_squeeze", squeeze)


def _add(context: EvaluationContext, name: str, distance: LpipsDistance) -> None:
    rows = [
        {name: distance(context.rendered[frame.index].rgb, frame.rgb, frame.tissue_mask)} for frame in context.frames
    ]
    context.add_frames(rows, "no tissue in the split")


def squeeze_distance(context: EvaluationContext, name: str) -> LpipsDistance | None:
    """The distance by SqueezeNet; None, with the reason recorded for the score `name`, where it cannot be computed."""
    if not context.networks:
        context.skip(name, NETWORKS_OFF)
        return None
    with context.skip_if_unavailable(name):
        return lpips_distance("squeeze", context.weights_dir, download=False)
    return None


@dataclass(frozen=True)
class LpipsDistance:
    """The distance, ready to be called on one frame after another."""

    network: Module
    lowest: Literal[-1, 0] = -1
    """Value of black in what the network sees; white is 1. The network is calibrated for -1."""

    def __call__(self, image: NDArray, target: NDArray, scored_mask: Mask) -> float:
        """LPIPS of the masked images scaled to [lowest, 1], averaged over the frame; NaN for an empty mask.
        ScoreUnavailable where a side is shorter than `MIN_SIZE`.
        """
        import torch

        check_images(image, target, scored_mask)
        height, width = scored_mask.shape
        if min(height, width) < MIN_SIZE:
            raise ScoreUnavailable(f"LPIPS needs images of at least {MIN_SIZE} px a side; got {width}x{height}")
        if not scored_mask.any():
            return float("nan")
        scale = np.float32(1 - self.lowest)
        scaled = (
            np.where(scored_mask[..., None], x, 0).astype(np.float32) * scale + self.lowest for x in (image, target)
        )
        a, b = (torch.from_numpy(x).permute(2, 0, 1)[None] for x in scaled)
        with torch.inference_mode():
            return float(self.network(a, b))


def lpips_distance(backbone: Backbone, weights_dir: Path | None = None, *, download: bool = True) -> LpipsDistance:
    """Load LPIPS; "vgg" is for protocols. Arguments and errors as `find_weights`; also without the packages."""
    import_torchvision()
    found = find_weights(CLASSIFIERS[backbone], weights_dir, download=download)
    network, heads = _untrained(backbone)
    state = network.state_dict()
    # torchvision's name is `features.5.squeeze.weight` for `net.slice3.5.squeeze.weight`.
    trunk = {name: "features." + name.split(".", 2)[2] for name in state if name.startswith("net.")}
    weights = select_weights(found, state, trunk) | dict(load_weights(heads))
    missing, unexpected = network.load_state_dict(weights, strict=False)
    # Only the constants of the input scaling may stay as constructed; the heads' file names each head twice.
    unset = [name for name in missing if not name.startswith("scaling_layer.") and not name.startswith("lins.")]
    assert not unset and not unexpected, (unset, unexpected)
    return LpipsDistance(network.eval().requires_grad_(False))


def _untrained(backbone: str) -> tuple[Module, Path]:
    """The network with random weights, and the package's file of calibrated heads."""
    import torch

    try:
        import lpips
    except ImportError as error:
        raise ScoreUnavailable(missing_package("lpips", "networks", error)) from error
    # A new network has random weights; creating them must not change the caller's random numbers.
    with torch.random.fork_rng(devices=[]), warnings.catch_warnings():
        # The package names the classifier's weights in torchvision's old way, even when it needs none.
        warnings.filterwarnings("ignore", message="The parameter 'pretrained' is deprecated", category=UserWarning)
        warnings.filterwarnings("ignore", message="Arguments other than a weight enum", category=UserWarning)
        # pnet_rand and pretrained=False skip the package's own loading: one part downloads, the other unpickles.
        network = lpips.LPIPS(pretrained=False, net=backbone, version=HEADS_VERSION, pnet_rand=True, verbose=False)
    heads = Path(lpips.__file__).parent / "weights" / f"v{HEADS_VERSION}" / f"{backbone}.pth"
    return network, heads
