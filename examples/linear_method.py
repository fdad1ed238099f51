"""Gaussians that move along straight lines."""

from torch import Tensor

from endoprior.core.config import Config
from endoprior.model.gaussians import Gaussians, Offsets
from endoprior.model.motion import Field, ModelOps, Motion
from endoprior.model.presets import paper
from endoprior.training.gaussian_method import GaussianMethod
from endoprior.training.ops import TrainingOps
from endoprior.training.optimizer import Rate
from endoprior.training.state import ForwardPass


class LinearMotion(Motion):
    """A velocity of each Gaussian, mm per sequence."""

    def tensors(self, cfg: Config) -> dict[str, tuple[int, ...]]:
        return {"velocities": (3,)}

    def offsets(
        self,
        gaussians: Gaussians,
        field: Field | None,
        time: float,
        cfg: Config,
        ops: ModelOps,
        chosen: Tensor | None = None,
    ) -> Offsets:
        velocities = gaussians["velocities"]
        return Offsets(means=(time - 0.5) * (velocities if chosen is None else velocities[chosen]))


class LinearMethod(GaussianMethod):
    """The paper's start and growth without its prior, and a pull towards no motion."""

    uses_prior = False
    _motion = LinearMotion()

    def motion(self, cfg: Config) -> Motion:
        return self._motion

    def rate(self, name: str, cfg: Config, spatial_scale: float) -> Rate:
        if name == "velocities":
            return lambda iteration: 1e-2
        return super().rate(name, cfg, spatial_scale)

    def terms(self, forward: ForwardPass, cfg: Config, ops: TrainingOps) -> dict[str, Tensor]:
        pull = 1e-4 * forward.gaussians["velocities"].square().mean()
        return super().terms(forward, cfg, ops) | {"pull": pull}


METHOD = LinearMethod()


def config() -> Config:
    """What `--preset linear` starts from."""
    return paper().replace(
        {
            "method": "linear",
            "temporal.weight": 0.0,
            "density.min_densify_weight": 1.0,
            "schedule.coarse_iterations": 0,
            "schedule.fine_iterations": 1500,
        }
    )
