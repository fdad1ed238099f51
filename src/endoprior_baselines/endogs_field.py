"""The field of EndoGS: HexPlane features and one network whose 59 outputs move all that a Gaussian has.

trunk: Linear F -> W, ReLU, Linear W -> W. Head: ReLU, Linear W -> W, ReLU, Linear W -> 59: center 3, scale 3,
rotation 4, opacity 1, color 48. Zhu et al., "EndoGS", 2024, as released.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import relu

from endoprior.compute.relu_network import relu_network
from endoprior.core.config import Config
from endoprior.core.config_deformation import DeformationConfig
from endoprior.model.gaussians import Gaussians
from endoprior.model.hexplane_field import HexPlaneField, HexPlaneMotion, LinearLayers, num_features
from endoprior.model.motion import Offsets
from endoprior.model.ops import ModelOps

UNIT_MM = 10.0
"""Unit of length of what the network gives. COLMAP's, which is any; with this one a scene 10 cm wide has the extent 5
that the release takes."""
OUTPUTS = {"means": 3, "log_scales": 3, "quats": 4, "opacity_logits": 1, "sh": 48}
"""What the head gives, in order."""


class JointField(HexPlaneField):
    """See the head of this file."""

    width = 256

    @classmethod
    def layer_shapes(cls, cfg: DeformationConfig) -> dict[str, tuple[int, int]]:
        """See `HexPlaneField.layer_shapes`."""
        width = cls.width
        layers = {"trunk": (width, num_features(cfg))} | {name: (width, width) for name in ("second", "hidden")}
        return layers | {"output": (sum(OUTPUTS.values()), width)}

    @classmethod
    def make_heads(cls, cfg: DeformationConfig, generator: torch.Generator, zero_biases: bool) -> LinearLayers:
        """See `HexPlaneField.make_heads`."""
        return LinearLayers(cls.layer_shapes(cfg), generator, zero_biases)

    def offsets(self, means: Tensor, time: float, ops: ModelOps) -> Offsets:
        """See `HexPlaneField.offsets`."""
        (trunk,) = self.trunk(means, (time,), ops)
        layers = [self.heads.layer(name) for name in ("second", "hidden", "output")]
        values = relu_network(relu(trunk), layers)
        parts = dict(zip(OUTPUTS, values.split(list(OUTPUTS.values()), 1), strict=True))
        parts["means"] = UNIT_MM * parts["means"]
        sh = parts.pop("sh").reshape(len(means), 16, 3)
        opacity = parts.pop("opacity_logits")[:, 0]
        return Offsets(**parts, opacity_logits=opacity, sh_dc=sh[:, 0], sh_rest=sh[:, 1:])


class JointMotion(HexPlaneMotion):
    """See `JointField`."""

    field_class = JointField

    def offsets(
        self,
        gaussians: Gaussians,
        field: JointField,
        time: float,
        cfg: Config,
        ops: ModelOps,
        chosen: Tensor | None = None,
    ) -> Offsets:
        """See `Motion.offsets`; colors beyond the degree of the Gaussians are left out."""
        found = super().offsets(gaussians, field, time, cfg, ops, chosen)
        return replace(found, sh_rest=found.sh_rest[:, : gaussians["sh_rest"].shape[1]])
