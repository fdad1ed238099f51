"""The configs of the two radiance fields, `endonerf` and `endosurf`: sized for two CPU cores, and as published."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated

from endoprior import Config, preset
from endoprior.core.ranges import Checked, Count, Range

SIZED_ITERATIONS, PUBLISHED_ITERATIONS = 2_000, 100_000


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


def radiance_of(cfg: Config) -> RadianceConfig:
    """What the config of a radiance field has beside `endoprior.Config`."""
    assert isinstance(cfg, RadianceFieldConfig)
    return cfg.radiance


def endonerf() -> Config:
    """EndoNeRF, a radiance field: slow on a CPU.

    2,000 iterations of 512 rays, without its depth refinement, which renders every frame.
    """
    return _config("endonerf", SIZED_ITERATIONS, RadianceConfig())


def endonerf_published() -> Config:
    """EndoNeRF's published schedule. It trained on all frames; here, as with every method, on training frames only."""
    return _config("endonerf", PUBLISHED_ITERATIONS, RadianceConfig(rays=2048, refine_every=4000))


def endosurf() -> Config:
    """EndoSurf, a radiance field with a surface: slow on a CPU.

    2,000 iterations of 512 rays; warm-up and annealing are the published shares of them.
    """
    return _config("endosurf", SIZED_ITERATIONS, RadianceConfig())


def endosurf_published() -> Config:
    """EndoSurf's published schedule."""
    return _config("endosurf", PUBLISHED_ITERATIONS, RadianceConfig(rays=1024))


def _config(method: str, iterations: int, radiance: RadianceConfig) -> Config:
    base = RadianceFieldConfig(**vars(preset("paper")) | {"method": method, "radiance": radiance})
    return replace(base, schedule=replace(base.schedule, coarse_iterations=0, fine_iterations=iterations))
