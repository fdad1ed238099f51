"""Linear layers with ReLU between them, a block of rows at a time on the CPU.

Whole layers of tens of thousands of rows do not fit into a cache, and on a busy machine fresh memory for each of them
costs as much as half of the matrix product. A block of rows goes through all layers while it is in the cache. Networks
that need second derivatives cannot use this.

N rows, I inputs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import linear

threshold_backward = torch.ops.aten.threshold_backward
"""The derivative of ReLU from what it gave; ten times as fast as a mask."""

BLOCK_ROWS = 2048
"""Rows of a block: 256 numbers of each are 2 MB; fewer keep two threads waiting for each other."""


def relu_network(
    inputs: Tensor, layers: Sequence[tuple[Tensor, Tensor]], *, skip: int = -1, repeated: int = 0
) -> Tensor:
    """What the last layer gives; each layer before it is followed by a ReLU.

    Args:
        inputs: (N, I).
        layers: weight (outputs, inputs) and bias (outputs,) of each.
        skip: the layer that gets the first `repeated` inputs again, before the outputs of the layer before it; not the
            first one. -1: none.
        repeated: how many; 0 without a skip.
    Returns:
        (N, outputs of the last layer).
    """
    if inputs.device.type != "cpu":
        return relu_network_torch(inputs, layers, skip=skip, repeated=repeated)
    weights, biases = zip(*layers, strict=True)
    if torch.is_grad_enabled() and any(each.requires_grad for each in (inputs, *weights, *biases)):
        return _Blocks.apply(skip, repeated, inputs, *weights, *biases)
    hidden = [inputs.new_empty(min(BLOCK_ROWS, len(inputs)), len(weight)) for weight in weights[:-1]]
    return _forward(inputs, weights, biases, skip, repeated, hidden)


def relu_network_torch(
    inputs: Tensor, layers: Sequence[tuple[Tensor, Tensor]], *, skip: int = -1, repeated: int = 0
) -> Tensor:
    """`relu_network` in plain torch, for every device and any number of derivatives."""
    values = inputs
    for k, (weight, bias) in enumerate(layers):
        if k:
            values = torch.relu(values)
        if k == skip:
            values = torch.cat([inputs[:, :repeated], values], -1)
        values = linear(values, weight, bias)
    return values


def _forward(
    inputs: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    skip: int,
    repeated: int,
    hidden: Sequence[Tensor],
) -> Tensor:
    """The last layer's outputs. `hidden` gets those of the others: (N, outputs) each, or one block that is reused."""
    out = inputs.new_empty(len(inputs), len(weights[-1]))
    for rows in _blocks(len(inputs)):
        first = values = inputs[rows]
        for k, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
            if k < len(hidden):
                kept = hidden[k][rows] if len(hidden[k]) == len(inputs) else hidden[k][: len(first)]
            else:
                kept = out[rows]
            if k == skip:
                torch.addmm(bias, first[:, :repeated], weight[:, :repeated].T, out=kept)
                kept.addmm_(values, weight[:, repeated:].T)
            else:
                torch.addmm(bias, values, weight.T, out=kept)
            values = kept.relu_() if k < len(hidden) else kept
    return out


class _Blocks(torch.autograd.Function):
    """`relu_network_torch` and its first derivative, in blocks of rows."""

    @staticmethod
    def forward(ctx: Any, skip: int, repeated: int, inputs: Tensor, *parameters: Tensor) -> Tensor:
        weights, biases = parameters[: len(parameters) // 2], parameters[len(parameters) // 2 :]
        hidden = [inputs.new_empty(len(inputs), len(weight)) for weight in weights[:-1]]
        ctx.skip, ctx.repeated = skip, repeated
        ctx.save_for_backward(inputs, *weights, *hidden)
        return _forward(inputs, weights, biases, skip, repeated, hidden)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_out: Tensor) -> tuple[Tensor | None, ...]:
        skip, repeated, saved = ctx.skip, ctx.repeated, ctx.saved_tensors
        num = len(saved) // 2
        inputs, weights, hidden = saved[0], saved[1 : 1 + num], saved[1 + num :]
        v_inputs = torch.empty_like(inputs) if ctx.needs_input_grad[2] else None
        v_weights = [torch.zeros_like(weight) for weight in weights]
        v_biases = [weight.new_zeros(len(weight)) for weight in weights]
        for rows in _blocks(len(inputs)):
            first, v_values = inputs[rows], v_out[rows]
            v_repeated = None
            for k in range(num - 1, -1, -1):
                weight, v_weight = weights[k], v_weights[k]
                v_biases[k] += v_values.sum(0)
                if k == skip:
                    v_weight[:, :repeated].addmm_(v_values.T, first[:, :repeated])
                    if v_inputs is not None:
                        v_repeated = v_values @ weight[:, :repeated]
                    weight, v_weight = weight[:, repeated:], v_weight[:, repeated:]
                v_weight.addmm_(v_values.T, hidden[k - 1][rows] if k else first)
                if k:
                    v_values = threshold_backward(v_values @ weight, hidden[k - 1][rows], 0)
                elif v_inputs is not None:
                    torch.mm(v_values, weight, out=v_inputs[rows])
            if v_inputs is not None and v_repeated is not None:
                v_inputs[rows, :repeated] += v_repeated
        return None, None, v_inputs, *v_weights, *v_biases


def _blocks(num: int) -> list[slice]:
    return [slice(start, min(start + BLOCK_ROWS, num)) for start in range(0, num, BLOCK_ROWS)]
