"""Our own method: the paper's prior, and either of the two ways to move that the config names."""

from __future__ import annotations

from ..core.config import Config
from ..core.presets import default
from ..model.motion import BasisMotion, HexPlaneMotion, Motion
from ..training.gaussian_method import GaussianMethod

MOTIONS: dict[str, Motion] = {"hexplane": HexPlaneMotion(), "basis": BasisMotion()}


class OwnMethod(GaussianMethod):
    """See `GaussianMethod`, whose defaults it consists of."""

    color_is_error = True

    def config(self) -> Config:
        """See `Method.config`."""
        return default()

    def motion(self, cfg: Config) -> Motion:
        """See `Method.motion`."""
        return MOTIONS[cfg.deformation.kind]


METHOD = OwnMethod()
