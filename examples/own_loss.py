"""A loss term on top of preset `default`: large areas must have the color of the frame, however fine detail fits."""

from dataclasses import dataclass
from typing import Annotated

from torch import Tensor
from torch.nn.functional import avg_pool2d

from endoprior.core.config import Config
from endoprior.core.ranges import Range
from endoprior.training.ops import TrainingOps
from endoprior.training.own_method import OwnMethod
from endoprior.training.state import ForwardPass

AREA_PX = 8


@dataclass(frozen=True)
class OwnLossConfig(Config):
    """The config of `default`, and one option more: `--areas-weight`."""

    method: str = "own-loss"
    areas_weight: Annotated[float, Range(0, 1e9)] = 0.5


def areas(forward: ForwardPass) -> Tensor:
    """Absolute difference of mean colors over squares of tissue, ()."""
    frame = forward.frame
    error = (forward.out.color - frame.rgb) * frame.counted(frame.tissue_mask)[..., None]
    return avg_pool2d(error.permute(2, 0, 1), AREA_PX).abs().mean()


class OwnLoss(OwnMethod):
    """`default` with the term."""

    config_type = OwnLossConfig

    def terms(self, forward: ForwardPass, cfg: Config, ops: TrainingOps) -> dict[str, Tensor]:
        assert isinstance(cfg, OwnLossConfig)
        return super().terms(forward, cfg, ops) | {"areas": cfg.areas_weight * areas(forward)}


METHOD = OwnLoss()
