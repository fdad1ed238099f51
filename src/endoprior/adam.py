"""Adam for one parameter: its moments, how often it was stepped, and the update. Kingma and Ba, 2015, Algorithm 1."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .adam_kernels import BETA1, BETA2, adam_definition, adam_flat, adam_outer, fused_step
from .compiled import compiled
from .model.basis import RankOneGradient


class AdamState:
    """Moments of one parameter, and how often it was stepped: a temporal basis counts each of its functions.

    On a device nothing here waits for it: counts live there, and so does what may forbid a step, `frozen` () float32:
    where it is not 0, parameter, moments and counts stay as they are.
    """

    def __init__(self, param: Tensor, num_counts: int = 1) -> None:
        self.first = torch.zeros_like(param, requires_grad=False)
        self.second = torch.zeros_like(param, requires_grad=False)
        self.steps = torch.zeros(num_counts, device=param.device)
        """(num_counts,) whole numbers."""

    def update(self, param: Tensor, rate: float, epsilon: float, frozen: Tensor | None = None) -> None:
        """One step of the whole parameter, a leaf with `.grad`; without a gradient nothing happens."""
        if param.grad is None or param.numel() == 0:
            return
        if not compiled(param):
            tensors = (param.detach(), param.grad.contiguous(), self.first, self.second, self.steps[0])
            fused_step(*tensors, rate, epsilon, frozen)
            return
        self.steps += 1
        rates, root_scale = _corrected(np.array([rate]), self._counts())
        tensors = (param, param.grad.contiguous(), self.first, self.second)
        adam_flat(*(t.detach().reshape(-1).numpy() for t in tensors), rates[0], root_scale[0], *_constants(epsilon))

    def update_bases(
        self,
        param: Tensor,
        gradients: list[RankOneGradient],
        rates: NDArray,
        epsilon: float,
        frozen: Tensor | None = None,
    ) -> None:
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
        begin, end = int(active[0]), int(active[-1]) + 1
        if not compiled(param):
            self._update_band(param, gradients, slice(begin, end), rates, epsilon, frozen)
            return
        self.steps[begin:end] += 1
        scaled, root_scale = _corrected(rates[None, :], self._counts()[begin:end, None])
        v_offsets = np.stack([gradient.v_offsets.numpy() for gradient in gradients])
        views = (param.detach().numpy(), weights, v_offsets, self.first.numpy(), self.second.numpy())
        adam_outer(*views, begin, scaled, root_scale[:, 0], *_constants(epsilon))

    def _update_band(
        self,
        param: Tensor,
        gradients: list[RankOneGradient],
        band: slice,
        rates: NDArray,
        epsilon: float,
        frozen: Tensor | None,
    ) -> None:
        """`update_bases` by the definition, on any device, of the basis functions in `band`."""
        grad = sum(_on(param, g.weights[None, band, None]) * g.v_offsets[:, None] for g in gradients)
        arrays = param.detach()[:, band], self.first[:, band], self.second[:, band]
        live = None if frozen is None else frozen == 0
        self.steps[band] += 1 if live is None else live
        counts = self.steps[band, None].clamp(min=1)  # where the first step is forbidden there is none
        scaled, root_scale = _on(param, rates) / (1 - BETA1**counts), (1 - BETA2**counts).rsqrt()
        adam_definition(arrays[0], grad, *arrays[1:], scaled, root_scale, epsilon, live)

    def _counts(self) -> NDArray[np.int64]:
        """The counts, whole numbers, of a state on the CPU."""
        return self.steps.numpy().astype(np.int64)


def _corrected(rates: NDArray, steps: NDArray) -> tuple[NDArray, NDArray]:
    """Learning rates over 1 - beta1^steps, and 1 / sqrt(1 - beta2^steps): Adam's corrections of its young moments."""
    return (rates / (1 - BETA1**steps)).astype(np.float32), (1 / np.sqrt(1 - BETA2**steps)).astype(np.float32)


def _constants(epsilon: float) -> tuple[np.float32, np.float32, np.float32]:
    return np.float32(BETA1), np.float32(BETA2), np.float32(epsilon)


def _on(like: Tensor, array: NDArray) -> Tensor:
    """The numbers as float32 where `like` is; the copy is queued, nobody waits for it."""
    return torch.from_numpy(np.ascontiguousarray(array, np.float32)).to(like.device, non_blocking=True)
