"""Our own method: the paper's prior, and either of the two ways to move that the config names."""

from __future__ import annotations

from ..core.config import Config
from ..model.basis import BasisMotion
from ..model.hexplane_field import HexPlaneMotion
from ..model.motion import Motion
from .gaussian_method import GaussianMethod

MOTIONS: dict[str, Motion] = {"hexplane": HexPlaneMotion(), "basis": BasisMotion()}


class OwnMethod(GaussianMethod):
    """See `GaussianMethod`, whose defaults it consists of."""

    starts_from_flow = True
    color_is_error = True

    def motion(self, cfg: Config) -> Motion:
        """See `Method.motion`."""
        return MOTIONS[cfg.deformation.kind]


METHOD = OwnMethod()
