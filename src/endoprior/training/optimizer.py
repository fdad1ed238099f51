"""Adam with one learning rate per parameter group, and the schedules of the rates."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ..core.config import Config, OptimConfig
from ..model.attributes import ATTRIBUTES, attribute_shapes, motion_layout
from ..model.deformation import HexPlaneField
from ..model.gaussians import Gaussians
from .adam import AdamState
from .divergence import LARGEST_GRADIENT
from .ops import TrainingOps
from .plane_adam import PlaneAdam

LATE = 0.75
"""Share of `decay_iterations` after which the rates without a final value begin to fall."""


@dataclass(frozen=True)
class ParameterGroup:
    """Parameters with one learning rate."""

    names: tuple[str, ...]
    rate: Callable[[int], float]
    """Learning rate at an iteration (1-based, within the stage)."""


class Optimizer:
    """Adam over the Gaussians and the deformation field of one stage; made anew, moments and all, for each stage."""

    def __init__(
        self, gaussians: Gaussians, field: HexPlaneField | None, cfg: Config, spatial_scale: float, ops: TrainingOps
    ) -> None:
        """Args: spatial_scale: factor of the rates that are lengths, see `trainer.spatial_scale`."""
        self.gaussians, self.field, self.cfg, self._ops = gaussians, field, cfg, ops
        self.groups = gaussian_groups(cfg, spatial_scale) + (field_groups(field, cfg, spatial_scale) if field else ())
        self.states = {name: AdamState(param) for name, param in self._dense().items()}
        if "motion" in gaussians.tensors:
            self.states["motion"] = AdamState(gaussians["motion"], gaussians["motion"].shape[1])
        self.planes = PlaneAdam(field.grid, cfg.optim.epsilon) if field else None
        self._planes_rate = field and plane_rate(cfg.optim, spatial_scale)

    def step(self, iteration: int, skip: Tensor | None = None) -> None:
        """Apply the gradients and clear them. What got no gradient stays unchanged, momentum included.

        Args:
            iteration: 1-based, within the stage.
            skip: () float32 on a device; where it is 1 the gradients are only cleared.
        """
        epsilon, params = self.cfg.optim.epsilon, self._dense()
        for group in self.groups:
            names = [name for name in group.names if params[name].grad is not None and params[name].numel()]
            if names:
                states = [self.states[name] for name in names]
                self._ops.adam_step(states, [params[name] for name in names], group.rate(iteration), epsilon, skip)
        gradients = self.gaussians.motion_gradients
        if gradients and self.gaussians["motion"].numel():
            rates, tiny = motion_rates(self.cfg, iteration), self.cfg.optim.basis_epsilon
            self._ops.adam_basis_step(self.states["motion"], self.gaussians["motion"], gradients, rates, tiny, skip)
        if self.planes and any(param.grad is not None for param in _field_parameters(self.field).values()):
            self._ops.adam_planes_step(self.planes, self._planes_rate(iteration), skip)
        self._clear_dense()

    def count_unusable(self) -> dict[str, int | Tensor]:
        """How many entries of each gradient are not finite or too large to be squared, by name."""
        found = {name: param.grad for name, param in self._dense().items() if param.grad is not None}
        found |= {f"motion, time step {i}": g.v_offsets for i, g in enumerate(self.gaussians.motion_gradients)}
        counts = {name: self._ops.count_unusable(grad, LARGEST_GRADIENT) for name, grad in found.items()}
        if self.field is not None:
            counts["planes"] = self._ops.count_unusable_in_planes(self.field.grid, LARGEST_GRADIENT)
        return counts

    def drop_gradients(self) -> None:
        """Drop every gradient of an iteration that is not to be applied."""
        self._clear_dense()
        if self.field is not None:
            self.field.grid.clear_grads()

    def state_arrays(self) -> dict[str, Tensor]:
        """Moments and step counts by name, for a checkpoint."""
        return {f"{name}.{key}": value for name, state in self._all_states() for key, value in state.arrays().items()}

    def load_state_arrays(self, arrays: dict[str, Tensor]) -> None:
        """Inverse of `state_arrays`."""
        for name, state in self._all_states():
            prefix = f"{name}."
            state.load({key.removeprefix(prefix): v for key, v in arrays.items() if key.startswith(prefix)})

    def _all_states(self) -> list[tuple[str, AdamState | PlaneAdam]]:
        return [*self.states.items(), *([("plane_adam", self.planes)] if self.planes else [])]

    def _dense(self) -> dict[str, Tensor]:
        """Parameters whose gradient autograd writes to `.grad`, by name."""
        found = {name: value for name, value in self.gaussians.tensors.items() if name != "motion"}
        return found | (_field_parameters(self.field) if self.field else {})

    def _clear_dense(self) -> None:
        for param in self._dense().values():
            param.grad = None
        self.gaussians.motion_gradients.clear()


def log_linear(start: float, end: float, iteration: int, steps: int) -> float:
    """Learning rate that falls from `start` to `end` over `steps` iterations, linearly in its logarithm, then holds."""
    share = min(max(iteration / steps, 0.0), 1.0)
    return math.exp(math.log(start) * (1 - share) + math.log(end) * share)


def late_share(optim: OptimConfig, iteration: int) -> float:
    """Share of a rate without a final value that is left at an iteration: see `OptimConfig.late_decay`."""
    begin = round(LATE * optim.decay_iterations)
    return log_linear(1.0, optim.late_decay, iteration - begin, max(optim.decay_iterations - begin, 1))


def gaussian_groups(cfg: Config, spatial_scale: float) -> tuple[ParameterGroup, ...]:
    """One group per attribute of the Gaussians but `motion`.

    A rate with a final value is a length and decays all along; the others decay late.
    """

    def rate_of(field: str) -> Callable[[int], float]:
        start, end = getattr(cfg.optim, field), getattr(cfg.optim, f"{field}_final", None)
        if end is None:
            return lambda iteration: start * late_share(cfg.optim, iteration)
        return lambda iteration: spatial_scale * log_linear(start, end, iteration, cfg.optim.decay_iterations)

    present = attribute_shapes(cfg)
    return tuple(ParameterGroup((a.name,), rate_of(a.rate)) for a in ATTRIBUTES if a.name in present)


def field_groups(field: HexPlaneField, cfg: Config, spatial_scale: float) -> tuple[ParameterGroup, ...]:
    """The network and, if it is trained, the box, which has the rate of the planes."""
    optim, names = cfg.optim, _field_parameters(field)
    steps = optim.decay_iterations

    def network_rate(iteration: int) -> float:
        return spatial_scale * log_linear(optim.network_lr, optim.network_lr_final, iteration, steps)

    network = ParameterGroup(tuple(name for name in names if name != "box"), network_rate)
    box = ParameterGroup(tuple(name for name in names if name == "box"), plane_rate(optim, spatial_scale))
    return network, box


def plane_rate(optim: OptimConfig, spatial_scale: float) -> Callable[[int], float]:
    """Schedule of the planes' learning rate."""
    return lambda iteration: (
        spatial_scale * log_linear(optim.planes_lr, optim.planes_lr_final, iteration, optim.decay_iterations)
    )


def motion_rates(cfg: Config, iteration: int) -> NDArray:
    """(C,) learning rate of each channel of the temporal coefficients."""
    decay = log_linear(1.0, cfg.optim.basis_decay, iteration, cfg.optim.decay_iterations)
    rates = {a.name: getattr(cfg.optim, a.basis_rate) for a in ATTRIBUTES if a.basis_rate}
    layout = motion_layout(cfg.deformation)
    return np.concatenate([np.full(part.stop - part.start, rates[name] * decay) for name, part in layout.items()])


def _field_parameters(field: HexPlaneField) -> dict[str, Tensor]:
    """Network and box by name; the box only if it is trained."""
    named = {f"network.{i}": value for i, value in enumerate(field.heads.parameters.values())}
    return named | ({"box": field.box} if field.box.requires_grad else {})
