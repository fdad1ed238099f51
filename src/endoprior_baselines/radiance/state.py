"""What changes while a radiance field is trained; a checkpoint holds exactly this."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from endoprior.system.arrays_file import ArraySpec, part
from endoprior.training.trainer import Stage

from .field import RadianceField

MOMENTS = {"first": "exp_avg", "second": "exp_avg_sq"}
"""Adam's moments: name in a checkpoint, name in torch."""


@dataclass
class RadianceState:
    """All that changes while training."""

    stage: Stage
    """Always the fine one."""
    iteration: int
    """Iterations already done."""
    field: RadianceField
    optimizer: torch.optim.Adam
    depths: Tensor | None
    """(F, H, W) depth of each training frame, mm, 0 where missing, on the CPU; None where it is not refined."""

    def arrays(self) -> dict[str, Tensor]:
        """Every tensor by the name that it has in a checkpoint."""
        arrays = {f"field.{name}": value for name, value in self.field.state_dict().items()}
        for name, parameter in self.field.named_parameters():
            known = self.optimizer.state.get(parameter, {})
            for moment, stored in MOMENTS.items():
                arrays[f"optimizer.{name}.{moment}"] = known.get(stored, torch.zeros_like(parameter.detach()))
            steps = int(known["step"]) if known else 0
            arrays[f"optimizer.{name}.steps"] = torch.tensor([steps], dtype=torch.int64)
        return arrays if self.depths is None else arrays | {"depths": self.depths}

    def load(self, iteration: int, arrays: Mapping[str, Tensor]) -> None:
        """Take over what `arrays` gave, trusted to fit."""
        self.iteration = iteration
        self.field.load_state_dict(part(arrays, "field."))
        for name, parameter in self.field.named_parameters():
            held = part(arrays, f"optimizer.{name}.")
            if int(held["steps"]):
                moments = {stored: held[moment].to(parameter.device) for moment, stored in MOMENTS.items()}
                self.optimizer.state[parameter] = {"step": held["steps"][0].float(), **moments}
        self.depths = arrays.get("depths")


def state_schema(field: RadianceField, depths: tuple[int | str, ...] | None) -> dict[str, ArraySpec]:
    """The arrays of a state; `depths` is the shape of the refined depths, None without them."""
    schema = {f"field.{name}": spec for name, spec in type(field).schema(field.cfg).items()}
    for name, parameter in field.named_parameters():
        moment = ArraySpec("float32", tuple(parameter.shape))
        schema |= {f"optimizer.{name}.{each}": moment for each in MOMENTS}
        schema[f"optimizer.{name}.steps"] = ArraySpec("int64", (1,))
    return schema if depths is None else schema | {"depths": ArraySpec("float32", depths)}
