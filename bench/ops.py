"""Every operation of model and training in Numba, beside the same operation in PyTorch."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import common
import numpy as np
import scenes
import torch

from endoprior.compute.relu_network import relu_network, relu_network_torch
from endoprior.core.config_deformation import DeformationConfig
from endoprior.model.basis import TRAINED, basis_offsets
from endoprior.model.gaussians import RankOneGradient, temporal_shapes
from endoprior.model.hexplane_field import HexPlaneField
from endoprior.model.presets import preset
from endoprior.training.adam import AdamState, PlaneAdam
from endoprior.training.ops import NUMBA, TORCH, TrainingOps
from endoprior.training.optimizer import Optimizer, rate_of, temporal_rates
from endoprior.training.temporal import MAX_SAMPLED_GAUSSIANS
from endoprior_baselines.surgicalgaussian import DEPTH, INPUTS, SKIP_AFTER, WIDTH, layer_shapes

TIME, RATE, EPSILON = 0.4, 1e-3, 1e-15
EARLIER_TIMES = (0.05, 0.2, 0.6, 0.85)
"""Steps at these come first: training has touched cells at other times too, and Adam steps them all."""
TORCH_MOST_PAIRS = 20_000
"""Points; PyTorch computes the distances of all pairs."""


def measure(sizes: tuple[common.Size, ...]) -> list[common.Row]:
    """Rows of every operation for each number of Gaussians, or for each image size."""
    measured = []
    for num in common.nums(sizes):
        for name, steps in (("hexplane + trunk", hexplane), ("motion basis", basis), ("optimizer", optimizer)):
            measured += common.rows(name, common.race(steps(num, NUMBA), steps(num, TORCH)), num)
        result = common.race(network(num, relu_network), network(num, relu_network_torch))
        measured += common.rows("network of 8 x 256", result, num)
    for num in sorted({MAX_SAMPLED_GAUSSIANS, *common.nums(sizes)}):
        other = temporal(num, TORCH) if num <= TORCH_MOST_PAIRS else None
        measured += common.rows("temporal term", common.race(temporal(num, NUMBA), other), num)
    for picture in common.pictures(sizes):
        result = common.race(losses(*picture, NUMBA), losses(*picture, TORCH))
        measured += common.rows("losses, both ways", result, None, picture)
    return measured


def hexplane(num: int, ops: TrainingOps) -> common.Steps:
    """HexPlane with the linear trunk on its features, both ways, and the planes' Adam step."""
    points, generator = scenes.sheet(num), torch.Generator().manual_seed(0)
    field = HexPlaneField.from_points(points, DeformationConfig(), generator)
    box, trunk, adam = field.box.detach(), field.heads.trunk, PlaneAdam(field.grid, EPSILON)
    unit = ((points - box[0]) / (box[1] - box[0])).requires_grad_()
    cotangent = torch.randn(num, field.width, generator=generator)

    def forward(time: float) -> torch.Tensor:
        (out,) = ops.model.hexplane_linear(field.grid, unit, (time,), *trunk)
        return out

    for time in EARLIER_TIMES:
        torch.autograd.grad(forward(time), [unit, *trunk], [cotangent])
        ops.adam_planes_step(adam, RATE)
    return {
        "forward": lambda _: forward(TIME),
        "backward": lambda out: torch.autograd.grad(out, [unit, *trunk], [cotangent]),
        "update": lambda _: ops.adam_planes_step(adam, RATE),
    }


def basis(num: int, ops: TrainingOps) -> common.Steps:
    """Offsets from temporal coefficients, their gradient and their Adam step."""
    cfg = preset("default").fitted(68)
    tensors = {n: torch.zeros(num, *shape, requires_grad=True) for n, shape in temporal_shapes(cfg).items()}
    states = {n: AdamState(tensors[n], tensors[n].shape[1]) for n in TRAINED}
    sink: list[RankOneGradient] = []

    def backward(offsets: object) -> None:
        found = [value for value in vars(offsets).values() if value is not None]
        torch.autograd.backward(found, [torch.ones_like(value) for value in found])

    def update(_: object) -> None:
        for name, state in states.items():
            gradients = [gradient for gradient in sink if gradient.name == name]
            ops.adam_basis_step(state, tensors[name], gradients, temporal_rates(name, cfg, 1), EPSILON)
        sink.clear()

    return {
        "forward": lambda _: basis_offsets(tensors, TIME, cfg, ops.model, sink),
        "backward": backward,
        "update": update,
    }


def network(num: int, of: Callable[..., torch.Tensor]) -> common.Steps:
    """The network that moves the Gaussians of `surgicalgaussian`; one of those of `endonerf` is alike."""
    generator, layers = torch.Generator().manual_seed(0), []
    for i in range(DEPTH):
        shape = layer_shapes()[f"layer.{i}"]
        weight, bias = (torch.randn(size, generator=generator) / 16 for size in (shape, shape[:1]))
        layers.append((weight.requires_grad_(), bias.requires_grad_()))
    inputs, cotangent = (torch.randn(num, width, generator=generator) for width in (INPUTS, WIDTH))
    parameters = [each for layer in layers for each in layer]
    return {
        "forward": lambda _: of(inputs, layers, skip=SKIP_AFTER + 1, repeated=INPUTS),
        "backward": lambda out: torch.autograd.grad(out, parameters, [cotangent]),
    }


def optimizer(num: int, ops: TrainingOps) -> common.Steps:
    """Adam over the canonical Gaussians: 59 numbers each, as under the preset `paper`."""
    cfg = preset("paper")
    splats, _ = scenes.splats(common.Size(num, 640, 512))
    gaussians = scenes.gaussians(splats, cfg)
    gradients = {name: torch.rand_like(value) for name, value in gaussians.tensors.items()}
    adam = Optimizer(gaussians, None, cfg, partial(rate_of, cfg=cfg, spatial_scale=10.0), ops)

    def give(_: object) -> None:
        for name, value in gaussians.tensors.items():
            value.grad = gradients[name]

    return {"_gradients": give, "": lambda _: adam.step(1)}


def temporal(num: int, ops: TrainingOps) -> common.Steps:
    """The temporal term and its gradient: neighbors, pair weights, Eq. (11)."""
    before = scenes.sheet(num)
    generator = torch.Generator().manual_seed(1)
    now = (before + 0.1 * torch.randn(num, 3, generator=generator)).requires_grad_()
    weights = torch.from_numpy(np.ones(num))
    return {"": lambda _: torch.autograd.grad(sum(ops.local_consistency(now, before, weights)), now)}


def losses(width: int, height: int, ops: TrainingOps) -> common.Steps:
    generator = torch.Generator().manual_seed(0)
    color = torch.rand(height, width, 3, generator=generator, requires_grad=True)
    depth = (torch.rand(height, width, generator=generator) * 60 + 40).requires_grad_()
    target = torch.randint(0, 256, (height, width, 3), generator=generator, dtype=torch.uint8)
    inverse = 1 / (torch.rand(height, width, generator=generator) * 60 + 40)
    mask = torch.rand(height, width, generator=generator) < 0.9
    given = (target, inverse, mask, mask, (1.0, 1.0, 0.03, 0.5))
    return {"": lambda _: torch.autograd.grad(ops.supervised_losses(color, depth, *given).sum(), (color, depth))}
