"""Adam over the Gaussians and their field, each parameter with a learning rate of its own, as the config says."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ..core.config import Config, OptimConfig
from ..model.basis import GIVEN, TRAINED
from ..model.gaussians import ATTRIBUTES, Gaussians, RankOneGradient, UnstoredGradient, change_layout
from ..model.motion import Field
from ..system.arrays_file import part
from .adam import AdamState, PlaneAdam, adam_unstored_step
from .divergence import MAX_GRADIENT
from .ops import TrainingOps

Rate = Callable[[int], float]  # learning rate at an iteration (1-based, within the stage)
PLANES = "planes"  # name of the planes of a field, among the names of parameters
RATES = {
    "sh_dc": 2.5e-3,
    "sh_rest": 1.25e-4,
    "color_slopes": 2.5e-3,
    "gloss": 2.5e-3,
    "opacity_logits": 5e-2,
    PLANES: 1.6e-3,
    "box": 1.6e-3,
}
"""Initial rates that no config sets: those of 3DGS, and of EndoGaussian's planes and box."""
SHORT_RATES = RATES | {"sh_dc": 4e-3, "opacity_logits": 8e-2}
"""Those of schedules that are not published ones: ours have a twentieth of the iterations. Slopes of colors that are
trained as fast diverge at the border of the image."""
NETWORK_LR = 1.6e-4  # initial rate of trunk and heads (EndoGaussian)
FINAL_SHARE = 0.01  # of the rates of centers, network and planes, left at `decay_iterations`; log-linear in between
BASIS_OPACITY_LR = 2e-2  # rate of the temporal coefficients of opacities
BASIS_DECAY = 0.1  # share of the rates of temporal coefficients left at `decay_iterations`; log-linear in between
EPSILON, BASIS_EPSILON = 1e-15, 1e-7
"""Adam's epsilon, and that for temporal coefficients and gloss: else the faint gradient that leaks to what tools hide
would move it as fast as any other."""
LATE = 0.75  # share of `decay_iterations` after which the rates without a final value begin to fall


def log_linear(start: float, end: float, iteration: int, steps: int) -> float:
    """Learning rate that falls from `start` to `end` over `steps` iterations, linearly in its logarithm, then holds."""
    share = min(max(iteration / steps, 0.0), 1.0)
    return math.exp(math.log(start) * (1 - share) + math.log(end) * share)


def late_share(optim: OptimConfig, iteration: int) -> float:
    """Share of a rate without a final value that is left at an iteration: see `OptimConfig.late_decay`."""
    begin = round(LATE * optim.decay_iterations)
    return log_linear(1.0, optim.late_decay, iteration - begin, max(optim.decay_iterations - begin, 1))


def rate_of(name: str, cfg: Config, spatial_scale: float) -> Rate:
    """Rate of an attribute of the Gaussians, of a field's planes or box, or else of its network.

    Rates of centers, planes and network are lengths: `spatial_scale` multiplies them, and they decay all along; the
    others decay late.
    """
    optim = cfg.optim
    of_config = {"means": optim.means_lr, "quats": optim.quats_lr, "log_scales": optim.scales_lr}
    start = (of_config | (RATES if cfg.schedule.literal else SHORT_RATES)).get(name, NETWORK_LR)
    if name in {a.name for a in ATTRIBUTES} - {"means"}:
        return lambda iteration: start * late_share(optim, iteration)
    return lambda iteration: spatial_scale * log_linear(start, FINAL_SHARE * start, iteration, optim.decay_iterations)


def temporal_rates(name: str, cfg: Config, iteration: int) -> NDArray:
    """(C,) learning rate of each channel of `motion` or of `changes`."""
    decay = log_linear(1.0, BASIS_DECAY, iteration, cfg.optim.decay_iterations)
    if name == "motion":
        return np.full(3, cfg.optim.basis_lr * decay)
    layout, own = change_layout(cfg), {"opacity_logits": BASIS_OPACITY_LR}
    rates = [np.full(part.stop - part.start, own.get(each, cfg.optim.basis_lr)) for each, part in layout.items()]
    return np.concatenate(rates) * decay


class Optimizer:
    """Adam over the Gaussians and the deformation field of one stage; made anew, moments and all, for each stage."""

    def __init__(
        self, gaussians: Gaussians, field: Field | None, cfg: Config, rate_of: Callable[[str], Rate], ops: TrainingOps
    ) -> None:
        self.gaussians, self.field, self.cfg, self._ops = gaussians, field, cfg, ops
        self.states = {name: AdamState(param) for name, param in self._dense().items()}
        self.rates = {name: rate_of(name) for name in self.states}
        for name in TRAINED:
            if name in gaussians.tensors:
                self.states[name] = AdamState(gaussians[name], gaussians[name].shape[1])
        self.planes = PlaneAdam(field.grid, EPSILON) if field and field.grid else None
        if self.planes:
            self.rates[PLANES] = rate_of(PLANES)

    def step(self, iteration: int, skip: Tensor | None = None) -> None:
        """Apply the gradients and clear them. What got no gradient stays unchanged, momentum included.

        Args:
            iteration: 1-based, within the stage.
            skip: () float32 on a device; where it is 1 the gradients are only cleared.
        """
        groups: dict[tuple[float, float], list[tuple[AdamState, Tensor]]] = defaultdict(list)
        for name, param in self._dense().items():
            if param.grad is not None and param.numel():
                epsilon = BASIS_EPSILON if name == "gloss" else EPSILON
                groups[self.rates[name](iteration), epsilon].append((self.states[name], param))
        for (rate, epsilon), group in groups.items():
            self._ops.adam_step([state for state, _ in group], [param for _, param in group], rate, epsilon, skip)
        if self.gaussians.motion_gradients and len(self.gaussians):
            self._step_motion(iteration, skip)
        if self.planes and self.field and any(param.grad is not None for param in self.field.parameters.values()):
            self._ops.adam_planes_step(self.planes, self.rates[PLANES](iteration), skip)
        self._clear_dense()

    def _step_motion(self, iteration: int, skip: Tensor | None) -> None:
        gaussians, gradients = self.gaussians, self.gaussians.motion_gradients
        if unstored := [gradient for gradient in gradients if isinstance(gradient, UnstoredGradient)]:
            names = unstored[0].names
            states, params = [self.states[name] for name in names], [gaussians[name] for name in names]
            adam_unstored_step(states, params, unstored, self.rates[names[0]](iteration), EPSILON)
            return
        for name in TRAINED:
            if own := [each for each in gradients if isinstance(each, RankOneGradient) and each.name == name]:
                rates = temporal_rates(name, self.cfg, iteration)
                self._ops.adam_basis_step(self.states[name], gaussians[name], own, rates, BASIS_EPSILON, skip)

    def count_unusable(self) -> dict[str, int | Tensor]:
        """How many entries of each gradient are not finite or too large to be squared, by name."""
        found = {name: param.grad for name, param in self._dense().items() if param.grad is not None}
        found |= {f"motion, time step {i}": g.v_offsets for i, g in enumerate(self.gaussians.motion_gradients)}
        counts = {name: self._ops.count_unusable(grad, MAX_GRADIENT) for name, grad in found.items()}
        if self.planes:
            counts["planes"] = self._ops.count_unusable_in_planes(self.planes.grid, MAX_GRADIENT)
        return counts

    def drop_gradients(self) -> None:
        """Drop every gradient of an iteration that is not to be applied."""
        self._clear_dense()
        if self.planes:
            self.planes.grid.clear_grads()

    def state_arrays(self) -> dict[str, Tensor]:
        """Moments and step counts by name, for a checkpoint."""
        return {f"{name}.{key}": value for name, state in self._all_states() for key, value in state.arrays().items()}

    def load_state_arrays(self, arrays: dict[str, Tensor]) -> None:
        """Inverse of `state_arrays`."""
        for name, state in self._all_states():
            state.load(part(arrays, f"{name}."))

    def _all_states(self) -> list[tuple[str, AdamState | PlaneAdam]]:
        return [*self.states.items(), *([("plane_adam", self.planes)] if self.planes else [])]

    def _dense(self) -> dict[str, Tensor]:
        """Parameters whose gradient autograd writes to `.grad`, by name."""
        found = {name: value for name, value in self.gaussians.tensors.items() if name not in (*TRAINED, *GIVEN)}
        return found | (self.field.parameters if self.field else {})

    def _clear_dense(self) -> None:
        for param in self._dense().values():
            param.grad = None
        self.gaussians.motion_gradients.clear()
