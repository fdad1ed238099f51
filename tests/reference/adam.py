"""Adam as Kingma and Ba write it, Algorithm 1."""

from __future__ import annotations

from torch import Tensor

from endoprior.training.adam import BETA1, BETA2

EPSILON = 1e-15


def step(param: Tensor, grad: Tensor, first: Tensor, second: Tensor, number: int, rates: Tensor | float) -> None:
    """Step `number`, from 1, in place."""
    first.mul_(BETA1).add_((1 - BETA1) * grad)
    second.mul_(BETA2).add_((1 - BETA2) * grad * grad)
    param.sub_(rates * (first / (1 - BETA1**number)) / ((second / (1 - BETA2**number)).sqrt() + EPSILON))
