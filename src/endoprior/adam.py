"""Adam for one parameter: its moments, how often it was stepped, and the update. Kingma and Ba, 2015, Algorithm 1."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .adam_kernels import BETA1, BETA2, adam_definition, adam_flat, adam_outer
from .compiled import compiled
from .model.basis import RankOneGradient


class AdamState:
    """Moments of one parameter, and how often it was stepped: a temporal basis counts each of its functions."""

    def __init__(self, param: Tensor, num_counts: int = 1) -> None:
        self.first = torch.zeros_like(param, requires_grad=False)
        self.second = torch.zeros_like(param, requires_grad=False)
        self.steps = np.zeros(num_counts, np.int64)

    def update(self, param: Tensor, rate: float, epsilon: float) -> None:
        """One step of the whole parameter, a leaf with `.grad`; without a gradient nothing happens."""
        if param.grad is None or param.numel() == 0:
            return
        self.steps += 1
        rates, root_scale = _corrected(np.array([rate]), self.steps)
        if not compiled(param):
            moments = self.first, self.second
            adam_definition(param.detach(), param.grad, *moments, float(rates[0]), float(root_scale[0]), epsilon)
            return
        tensors = (param, param.grad.contiguous(), self.first, self.second)
        adam_flat(*(t.detach().reshape(-1).numpy() for t in tensors), rates[0], root_scale[0], *_constants(epsilon))

    def update_bases(self, param: Tensor, gradients: list[RankOneGradient], rates: NDArray, epsilon: float) -> None:
        """One step of the basis functions that any of the gradients reaches; the others keep value, moments and count.

        Stepping the others on momentum alone would move the tissue at moments that were not looked at.

        Args:
            param: (N, B, C). rates: (C,) learning rate of each channel.
        """
        if not gradients or param.numel() == 0:
            return
        weights = np.stack([gradient.weights for gradient in gradients]).astype(np.float32)
        active = np.flatnonzero(weights.any(0))
        if len(active) == 0:
            return
        begin, end = active[0], active[-1] + 1
        self.steps[begin:end] += 1
        scaled, root_scale = _corrected(rates[None, :], self.steps[begin:end, None])
        if not compiled(param):
            band = (slice(None), slice(begin, end))
            grad = sum(
                _on(param, gradient.weights[None, begin:end, None]) * gradient.v_offsets[:, None]
                for gradient in gradients
            )
            arrays = param.detach()[band], grad, self.first[band], self.second[band]
            adam_definition(*arrays, _on(param, scaled), _on(param, root_scale), epsilon)
            return
        v_offsets = np.stack([gradient.v_offsets.numpy() for gradient in gradients])
        views = (param.detach().numpy(), weights, v_offsets, self.first.numpy(), self.second.numpy())
        adam_outer(*views, begin, scaled, root_scale[:, 0], *_constants(epsilon))


def _corrected(rates: NDArray, steps: NDArray) -> tuple[NDArray, NDArray]:
    """Learning rates over 1 - beta1^steps, and 1 / sqrt(1 - beta2^steps): Adam's corrections of its young moments."""
    return (rates / (1 - BETA1**steps)).astype(np.float32), (1 / np.sqrt(1 - BETA2**steps)).astype(np.float32)


def _constants(epsilon: float) -> tuple[np.float32, np.float32, np.float32]:
    return np.float32(BETA1), np.float32(BETA2), np.float32(epsilon)


def _on(like: Tensor, array: NDArray) -> Tensor:
    """The numbers as float32 where `like` is; the copy is queued, nobody waits for it."""
    return torch.from_numpy(np.ascontiguousarray(array, np.float32)).to(like.device, non_blocking=True)
