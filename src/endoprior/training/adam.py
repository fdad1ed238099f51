"""Adam for one parameter: its moments, how often it was stepped, and the update. Kingma and Ba, 2015, Algorithm 1."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..compute.compiled import compiled
from ..model.basis import RankOneGradient
from .adam_kernels import BETA1, BETA2, adam_definition, adam_flat, adam_outer, fused_step


class AdamState:
    """Moments of one parameter, and how often it was stepped: a temporal basis counts each of its functions.

    On a device nothing here waits for it: counts live there, and so does what may forbid a step, `frozen` () float32:
    where it is 1, parameter, moments and counts stay as they are; else it is 0.
    """

    def __init__(self, param: Tensor, num_counts: int = 1, reach: int | None = None) -> None:
        """Start with zero moments.

        Args:
            num_counts: B for a temporal basis, else 1.
            reach: of a basis, most functions that one moment reaches; they are neighbors. None: any number.
        """
        self.reach = reach
        self.first = torch.zeros_like(param, requires_grad=False)
        self.second = torch.zeros_like(param, requires_grad=False)
        self.steps = torch.zeros(num_counts, device=param.device)
        """(num_counts,) whole numbers."""

    def update(self, param: Tensor, rate: float | Tensor, epsilon: float, frozen: Tensor | None = None) -> None:
        """One step of the whole parameter, a leaf with `.grad`; without a gradient nothing happens."""
        if param.grad is None or param.numel() == 0:
            return
        if not compiled(param):
            update_together([self], [param], rate, epsilon, frozen)
            return
        self.steps += 1
        rates, root_scale = _corrected(np.array([rate]), self._counts())
        tensors = (param, param.grad.contiguous(), self.first, self.second)
        adam_flat(*(t.detach().reshape(-1).numpy() for t in tensors), rates[0], root_scale[0], *_constants(epsilon))

    def update_bases(
        self,
        param: Tensor,
        gradients: list[RankOneGradient],
        rates: NDArray | Tensor,
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
        if not compiled(param):
            self._update_band(param, gradients, rates, epsilon, frozen)
            return
        weights = np.stack([gradient.weights for gradient in gradients]).astype(np.float32)
        active = np.flatnonzero(weights.any(0))
        if len(active) == 0:
            return
        begin, end = int(active[0]), int(active[-1]) + 1
        self.steps[begin:end] += 1
        scaled, root_scale = _corrected(rates[None, :], self._counts()[begin:end, None])
        v_offsets = np.stack([gradient.v_offsets.numpy() for gradient in gradients])
        views = (param.detach().numpy(), weights, v_offsets, self.first.numpy(), self.second.numpy())
        adam_outer(*views, begin, scaled, root_scale[:, 0], *_constants(epsilon))

    def _update_band(
        self,
        param: Tensor,
        gradients: list[RankOneGradient],
        rates: NDArray | Tensor,
        epsilon: float,
        frozen: Tensor | None,
    ) -> None:
        """`update_bases` by the definition, on any device.

        Which functions are reached is known on the device only, but not more than so many neighbors: they are taken
        out, stepped, and put back.
        """
        weights = torch.stack([_on(param, gradient.weights) for gradient in gradients])
        reached, num = (weights != 0).any(0), param.shape[1]
        width = min(self.reach or num, num) if len(gradients) == 1 else num
        first = reached.to(torch.uint8).argmax().clamp(max=num - width)
        band = first + torch.arange(width, device=param.device)
        live = reached[band] if frozen is None else reached[band] & (frozen == 0)
        grad = sum(w[band, None] * g.v_offsets[:, None] for w, g in zip(weights, gradients, strict=True))
        wholes = (param.detach(), self.first, self.second)
        parts = [whole.index_select(1, band) for whole in wholes]
        steps = self.steps[band] + live
        counts = steps.clamp(min=1)[:, None]  # where nothing was stepped yet there is no correction
        scaled, root_scale = _on(param, rates) / (1 - BETA1**counts), (1 - BETA2**counts).rsqrt()
        adam_definition(parts[0], grad, *parts[1:], scaled, root_scale, epsilon, live[:, None])
        for whole, part in zip(wholes, parts, strict=True):
            whole.index_copy_(1, band, part)
        self.steps.index_copy_(0, band, steps)

    def _counts(self) -> NDArray[np.int64]:
        """The counts, whole numbers, of a state on the CPU."""
        return self.steps.numpy().astype(np.int64)


def update_together(
    states: list[AdamState],
    params: list[Tensor],
    rate: float | Tensor,
    epsilon: float,
    frozen: Tensor | None = None,
) -> None:
    """`AdamState.update` of several parameters with one rate."""
    due = [(s, p) for s, p in zip(states, params, strict=True) if p.grad is not None and p.numel()]
    if not due:
        return
    if compiled(due[0][1]):
        for state, param in due:
            state.update(param, rate, epsilon)
        return
    tensors = [(p.detach(), p.grad.contiguous(), s.first, s.second, s.steps[0]) for s, p in due]
    fused_step(*map(list, zip(*tensors, strict=True)), rate, epsilon, frozen)


def _corrected(rates: NDArray, steps: NDArray) -> tuple[NDArray, NDArray]:
    """Learning rates over 1 - beta1^steps, and 1 / sqrt(1 - beta2^steps): Adam's corrections of its young moments."""
    return (rates / (1 - BETA1**steps)).astype(np.float32), (1 / np.sqrt(1 - BETA2**steps)).astype(np.float32)


def _constants(epsilon: float) -> tuple[np.float32, np.float32, np.float32]:
    return np.float32(BETA1), np.float32(BETA2), np.float32(epsilon)


def _on(like: Tensor, numbers: NDArray | Tensor) -> Tensor:
    """The numbers as float32 where `like` is; a copy is queued, nobody waits for it."""
    return torch.as_tensor(numbers).to(like.device, torch.float32, non_blocking=True)
