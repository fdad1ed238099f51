"""The configs of the two radiance fields: a size for two CPU cores, and the published schedule."""

from __future__ import annotations

from dataclasses import replace

from endoprior.core.config import Config
from endoprior.model.presets import paper

from .config import RadianceConfig, RadianceFieldConfig

SIZED_ITERATIONS, PUBLISHED_ITERATIONS = 2_000, 100_000


def endonerf() -> Config:
    """EndoNeRF, sized: 2,000 iterations of 512 rays. Without its depth refinement, which renders every frame."""
    return _config("endonerf", SIZED_ITERATIONS, RadianceConfig())


def endonerf_published() -> Config:
    """EndoNeRF's published schedule. It trained on all frames; here, as with every method, on training frames only."""
    return _config("endonerf", PUBLISHED_ITERATIONS, RadianceConfig(rays=2048, refine_every=4000))


def endosurf() -> Config:
    """EndoSurf, sized: 2,000 iterations of 512 rays; warm-up and annealing are the published shares of them."""
    return _config("endosurf", SIZED_ITERATIONS, RadianceConfig())


def endosurf_published() -> Config:
    """EndoSurf's published schedule."""
    return _config("endosurf", PUBLISHED_ITERATIONS, RadianceConfig(rays=1024))


def _config(method: str, iterations: int, radiance: RadianceConfig) -> Config:
    base = RadianceFieldConfig(**vars(paper()) | {"method": method, "radiance": radiance})
    return replace(base, schedule=replace(base.schedule, coarse_iterations=0, fine_iterations=iterations))
