"""Adam with one learning rate per group, its schedules, and the one place that resizes per-Gaussian tensors."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..compute.morton import morton_order
from ..core.config import Config, OptimConfig
from ..core.geometry import quaternion_to_matrix
from ..model.basis import bases_reached, motion_layout
from ..model.deformation import HexPlaneField
from ..model.gaussians import Gaussians
from ..model.hexplane_kernels import FRESH
from .adam import AdamState, update_together
from .density import DensityStats, Plan
from .divergence import ADVICE, Diverged, count_unusable, count_unusable_rows
from .plane_adam import PlaneAdam


def log_linear(start: float, end: float, iteration: int | Tensor, steps: int) -> float | Tensor:
    """Learning rate that falls from `start` to `end` over `steps` iterations, linearly in its logarithm, then holds.

    Of an iteration that is a () float64 tensor it is one too, () float32 where that lies.
    """
    if isinstance(iteration, Tensor):
        share = (iteration / steps).clamp(0, 1)
        return (math.log(start) * (1 - share) + math.log(end) * share).exp().float()
    share = min(max(iteration / steps, 0.0), 1.0)
    return math.exp(math.log(start) * (1 - share) + math.log(end) * share)


class Optimizer:
    """Adam over the Gaussians and the deformation field of one stage; rebuilt, moments and all, when a stage begins."""

    def __init__(self, gaussians: Gaussians, field: HexPlaneField | None, cfg: Config, spatial_scale: float) -> None:
        self.gaussians, self.field, self.cfg, self.spatial_scale = gaussians, field, cfg, spatial_scale
        self.states = {name: AdamState(value) for name, value in gaussians.tensors.items() if name != "motion"}
        if "motion" in gaussians.tensors:
            motion = gaussians["motion"]
            self.states["motion"] = AdamState(motion, motion.shape[1], bases_reached(cfg.deformation.basis))
            rates = torch.from_numpy(motion_rates(cfg, 0, cfg.optim.decay_iterations))
            self._motion_rates = rates.to(motion.device, torch.float32)
            """(C,) before they decay, where no kernel takes them."""
        self.plane_adam = None
        if field is not None:
            self.states |= {name: AdamState(value) for name, value in _field_parameters(field).items()}
            self.plane_adam = PlaneAdam(field.grid, epsilon=cfg.optim.epsilon)

    def step(self, iteration: int | Tensor, frozen: Tensor | None = None) -> None:
        """Apply the gradients and clear them. What got no gradient is left alone, momentum and all.

        Args:
            iteration: 1-based, within the stage; on a device a () float64 tensor.
            frozen: () float32 on a device, 0 or 1; where it is 1 the gradients are only cleared.
        """
        optim = self.cfg.optim
        decay = {"iteration": iteration, "steps": optim.decay_iterations}
        for name, param in self.gaussians.tensors.items():
            if name == "motion":
                gradients, rates = self.gaussians.motion_gradients, self._decayed_motion_rates(decay)
                self.states[name].update_bases(param, gradients, rates, optim.epsilon, frozen)
            else:
                self.states[name].update(param, self._rate(name, decay), optim.epsilon, frozen)
        if self.field is not None:
            network = self.spatial_scale * log_linear(optim.network_lr, optim.network_lr_final, **decay)
            planes = self.spatial_scale * log_linear(optim.planes_lr, optim.planes_lr_final, **decay)
            parameters = _field_parameters(self.field)
            for rate, names in ((network, parameters.keys() - {"box"}), (planes, parameters.keys() & {"box"})):
                ordered = sorted(names)
                states, params = [self.states[name] for name in ordered], [parameters[name] for name in ordered]
                update_together(states, params, rate, optim.epsilon, frozen)
            if any(param.grad is not None for param in parameters.values()):
                self.plane_adam.step(planes, frozen)
        self.clear_gradients()

    def gradients(self) -> dict[str, Tensor]:
        """The gradients that `step` will use, by name; those of the planes are `field.grid.grads`."""
        found = {name: value.grad for name, value in self.gaussians.tensors.items()}
        moments = self.gaussians.motion_gradients
        found |= {f"motion, moment {i}": moment.v_offsets for i, moment in enumerate(moments)}
        if self.field is not None:
            found |= {name: value.grad for name, value in _field_parameters(self.field).items()}
        return {name: grad for name, grad in found.items() if grad is not None}

    def count_unusable(self) -> dict[str, int]:
        """How many entries of each gradient `step` must not be given: not finite, or too large to be squared."""
        counts = {name: count_unusable(grad) for name, grad in self.gradients().items()}
        if self.field is not None:
            grid = self.field.grid
            counts["planes"] = count_unusable_rows(grid.grads, grid.marks, FRESH)
        return counts

    def largest_gradients(self) -> dict[str, Tensor]:
        """Largest magnitude in each gradient, () where it lies, NaN if there is any: nobody waits for a device."""
        found = self.gradients() | ({"planes": self.field.grid.grads} if self.field is not None else {})
        return {name: torch.linalg.vector_norm(grad, torch.inf) for name, grad in found.items() if grad.numel()}

    def clear_gradients(self) -> None:
        """Drop every gradient but those of the planes, which their own step clears."""
        for param in self.gaussians.tensors.values():
            param.grad = None
        self.gaussians.motion_gradients.clear()
        if self.field is not None:
            for param in _field_parameters(self.field).values():
                param.grad = None

    def drop_gradients(self) -> None:
        """Drop every gradient of an iteration that is not to be applied, those of the planes included."""
        self.clear_gradients()
        if self.field is not None:
            self.field.grid.clear_grads()

    def _decayed_motion_rates(self, decay: dict) -> NDArray | Tensor:
        if isinstance(decay["iteration"], Tensor):
            return self._motion_rates * log_linear(1.0, self.cfg.optim.basis_decay, **decay)
        return motion_rates(self.cfg, **decay)

    def _rate(self, name: str, decay: dict) -> float | Tensor:
        optim = self.cfg.optim
        if name == "means":
            return self.spatial_scale * log_linear(optim.means_lr, optim.means_lr_final, **decay)
        return {
            "quats": optim.quats_lr,
            "log_scales": optim.scales_lr,
            "opacity_logits": optim.opacity_lr,
            "sh_dc": optim.sh_dc_lr,
            "sh_rest": optim.sh_rest_lr,
        }[name]

    def apply_plan(self, plan: Plan, stats: DensityStats, rng: np.random.Generator) -> DensityStats:
        """Clone, split and remove as planned, in the parameters, Adam's moments and the statistics alike.

        Rows that stay keep everything; the gradient sums of all are cleared, as after each event. New rows start with
        zero moments and unobserved. All are then put in the order of `morton_order`.

        Returns:
            The statistics of the new set.
        Raises:
            Diverged: a new Gaussian would not be finite; nothing was changed.
        """
        tensors = self.gaussians.tensors
        children = split_children(self.gaussians, plan.split, self.cfg.density.split_shrink, rng)
        added = {name: torch.cat([value.detach()[plan.clone], children[name]]) for name, value in tensors.items()}
        if not all(bool(value.isfinite().all()) for value in added.values()):
            raise Diverged(f"expected Gaussians of a finite size to split; got others. {ADVICE}")
        staying = (~(plan.remove | plan.split)).nonzero()[:, 0]
        rows = torch.cat([staying, len(plan.split) + torch.arange(len(added["means"]), device=staying.device)])
        means = torch.cat([tensors["means"].detach(), added["means"]])[rows]
        rows = rows[torch.from_numpy(morton_order(means.cpu().numpy())).to(rows.device)]
        for name, value in tensors.items():
            tensors[name] = torch.cat([value.detach(), added[name]])[rows].requires_grad_()
            state = self.states[name]
            state.first, state.second = (_with_zeros(m, rows) for m in (state.first, state.second))
        grown = DensityStats(*(_with_zeros(value, rows) for value in stats.tensors().values()))
        grown.clear_gradient()
        return grown

    def tensors(self) -> list[Tensor]:
        """Moments and counts, as they are held."""
        found = [tensor for state in self.states.values() for tensor in (state.first, state.second, state.steps)]
        planes = self.plane_adam
        return found + ([planes.exp_avg, planes.exp_avg_sq, planes.steps] if planes else [])

    def state_arrays(self) -> dict[str, Tensor]:
        """Moments and step counts by name, for a checkpoint."""
        arrays = {}
        for name, state in self.states.items():
            arrays |= {f"{name}.first": state.first, f"{name}.second": state.second}
            arrays[f"{name}.steps"] = state.steps.to(torch.int64)
        return arrays | (self.plane_adam.state_arrays() if self.plane_adam else {})

    def load_state_arrays(self, arrays: dict[str, Tensor]) -> None:
        """Inverse of `state_arrays`."""
        for name, state in self.states.items():
            for moment in ("first", "second"):
                getattr(state, moment).copy_(arrays[f"{name}.{moment}"])
            state.steps.copy_(arrays[f"{name}.steps"])
        if self.plane_adam:
            self.plane_adam.load_state_arrays(arrays)


def _field_parameters(field: HexPlaneField) -> dict[str, Tensor]:
    """Network and box by name; the box only if it is trained."""
    groups = field.parameters_by_group()
    named = {f"network.{i}": value for i, value in enumerate(groups["network"])}
    return named | ({"box": groups["box"]} if groups["box"].requires_grad else {})


def motion_rates(cfg: Config, iteration: int, steps: int) -> NDArray:
    """(C,) learning rate of each channel of the temporal basis."""
    optim: OptimConfig = cfg.optim
    decay = log_linear(1.0, optim.basis_decay, iteration, steps)
    rates = {
        "means": optim.basis_means_lr,
        "quats": optim.basis_quats_lr,
        "log_scales": optim.basis_log_scales_lr,
        "opacity_logits": optim.basis_opacity_lr,
        "sh_dc": optim.basis_color_lr,
    }
    layout = motion_layout(cfg.deformation)
    return np.concatenate([np.full(part.stop - part.start, rates[name] * decay) for name, part in layout.items()])


def split_children(gaussians: Gaussians, split: Tensor, shrink: float, rng: np.random.Generator) -> dict[str, Tensor]:
    """Two children for each Gaussian marked in `split` (N,): centers drawn from it, scales divided by `shrink`."""
    tensors = {name: value.detach()[split] for name, value in gaussians.tensors.items()}
    children = {name: torch.cat([value, value]) for name, value in tensors.items()}
    scales, quats = children["log_scales"].exp().cpu().numpy(), children["quats"].cpu().numpy()
    offsets = rng.normal(size=scales.shape) * scales
    turned = np.einsum("nij,nj->ni", quaternion_to_matrix(quats.astype(np.float64)), offsets)
    children["means"] = children["means"] + torch.from_numpy(turned.astype(np.float32)).to(children["means"].device)
    children["log_scales"] = children["log_scales"] - math.log(shrink)
    return children


def _with_zeros(values: Tensor, rows: Tensor) -> Tensor:
    """The `rows` of `values`; those beyond its end are zeros."""
    chosen = values[rows.clamp(max=len(values) - 1)]
    chosen[rows >= len(values)] = 0
    return chosen
