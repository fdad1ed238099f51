"""What the config of a radiance field (`endonerf`, `endosurf`) has beside `endoprior.Config`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from endoprior.core.config import Config
from endoprior.core.ranges import Checked, Count, Range


@dataclass(frozen=True)
class RadianceConfig(Checked):
    """Rays and samples of a radiance field.

    Its rates reach 1e-2 at most: beyond that no such network learns anything.
    """

    rays: Annotated[int, Range(1, 65_536)] = 512
    """Rays of one training frame in each iteration."""
    even_samples: Annotated[int, Range(4, 1024)] = 32
    """Samples of a ray that are placed first: evenly, or around measured depth."""
    more_samples: Annotated[int, Range(4, 1024)] = 32
    """Samples of a ray that are placed where the first ones found a surface."""
    learning_rate: Annotated[float, Range(1e-30, 1e-2)] = 5e-4
    """Adam's highest rate."""
    refine_every: Count = 0
    """EndoNeRF renders the depth of all training frames and corrects outliers after so many iterations, four times;
    0 never does."""


@dataclass(frozen=True)
class RadianceFieldConfig(Config):
    """See `Config`."""

    radiance: RadianceConfig = field(default_factory=RadianceConfig)
