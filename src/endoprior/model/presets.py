"""Named configs: functions that return one. Every departure is listed, with its reason, in `docs/paper_map.md`.

Those of other methods are entry points of the group `endoprior.presets`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal

from ..core.checks import InputError
from ..core.config import Config, DataConfig, DensityConfig, InitConfig, OptimConfig, SalienceConfig, TemporalConfig
from ..core.config_deformation import DeformationConfig, HexPlaneConfig
from ..system.plugins import Registry


def preset(name: str = "default", **changes: Any) -> Config:
    """The config of a preset: `preset("default", iterations=3000, seed=1)`.

    Args:
        changes: other values, by names that `Config.replace` knows.
    Raises:
        InputError: no preset or field has this name, or a value has the wrong type or range.
    """
    if name not in preset_names():
        raise InputError(f"preset: expected one of {', '.join(preset_names())}; got {name!r}. Choose one of them.")
    made = PRESETS.load(name)()
    return made.replace(changes) if changes else made


def paper() -> Config:
    """The paper's equations and constants, literally; EndoGaussian's choices where the paper is silent."""
    return Config()


def released() -> Config:
    """What the authors' released code does where it differs from the paper."""
    return Config(
        data=DataConfig(lift_missing_depth=True),
        init=InitConfig(
            adaptive_specular=True,
            salience_on_eroded_mask=True,
            cleanup=True,
            pixel_offset="legacy",
            variance_factor=0.4,
        ),
        deformation=DeformationConfig(deform_opacity=True, hexplane=HexPlaneConfig(bias_init="zero")),
        density=DensityConfig(prune_max_scale_mm=40.0, score_mode="events", unobserved_score=1.0),
        temporal=TemporalConfig(
            huber_scale="released",
            adaptive_motion_weight=True,
            min_valid=1,
            valid_at_both=False,
            max_points=1024,
            refill=True,
            gradient="current",
        ),
        prior=replace(Config().prior, salience=SalienceConfig(border="zero")),
        optim=OptimConfig(decay_iterations=3000),
    )


def endogaussian() -> Config:
    """The baseline, conference version: no prior anywhere, pool sampling, plain 3DGS density control."""
    return Config(
        data=DataConfig(lift_missing_depth=True),
        init=InitConfig(sampler="pool", pixel_offset="legacy"),
        density=DensityConfig(min_densify_weight=1.0, prior_prune=False),
        temporal=TemporalConfig(weight=0.0),
    )


def default() -> Config:
    """What we recommend: the paper's prior, and motion as temporal coefficients of each Gaussian, seeded by flow.

    Its rates suit 1,500 iterations: those of 3DGS are meant for twenty times as many.
    """
    base = Config()
    return replace(
        base,
        init=replace(
            base.init, budget=30_000, motion="flow", thickness=0.3, opacity=0.3, fill_unseen=True, variance_factor=0.4
        ),
        deformation=replace(
            base.deformation,
            kind="basis",
            basis=replace(base.deformation.basis, num_bases=0),
            max_scale_change=2.0,
        ),
        render=replace(base.render, depth_grad_to_means=True, color_slopes=True),
        loss=replace(
            base.loss,
            depth_weight=6.0,
            edge_weight=0.5,
            track_weight=0.02,
            tv_weight=0.003,
            tv_on_tissue=False,
            cover_weight=0.01,
            trust_masks=False,
        ),
        temporal=replace(
            base.temporal, start_iteration=500, max_points=1024, min_valid=1, valid_at_both=False, gradient="current"
        ),
        density=replace(base.density, grow_threshold=3e-4, max_scale_share=0.025),
        optim=replace(
            base.optim,
            means_lr=5e-3,
            means_lr_final=5e-5,
            scales_lr=2e-2,
            quats_lr=1e-2,
            basis_means_lr=1e-2,
            basis_quats_lr=1e-2,
            basis_log_scales_lr=1e-2,
            basis_color_lr=1e-2,
            basis_epsilon=1e-7,
            late_decay=0.1,
            decay_iterations=1500,
        ),
        schedule=replace(
            base.schedule, coarse_iterations=0, fine_iterations=1500, half_resolution_iterations=500, sh_degree=0
        ),
        windows=replace(base.windows, enabled=True),
    )


def best() -> Config:
    """`default` with twice its iterations and nearly twice its Gaussians: the same method, given time."""
    base = default()
    return replace(
        base,
        init=replace(base.init, budget=50_000),
        density=replace(base.density, grow_threshold=2e-4),
        optim=replace(base.optim, decay_iterations=3000),
        schedule=replace(base.schedule, fine_iterations=3000, half_resolution_iterations=800),
    )


def preview() -> Config:
    """A first look: `default` with a third of its Gaussians and iterations. For small frames; not for scores."""
    base = default()
    return replace(
        base,
        init=replace(base.init, budget=10_000),
        temporal=replace(base.temporal, start_iteration=170),
        density=replace(base.density, start_iteration=170),
        optim=replace(base.optim, decay_iterations=500),
        schedule=replace(base.schedule, fine_iterations=500, half_resolution_iterations=170),
    )


OWN_PRESETS = {made.__name__: made for made in (default, best, paper, released, endogaussian, preview)}
"""Those of our own method."""
PRESETS = Registry(
    "presets",
    "a function without arguments that returns an endoprior.Config",
    lambda found: "" if callable(found) else f"an object of type {type(found).__name__}",
    modules=tuple(OWN_PRESETS),
    load_module=OWN_PRESETS.__getitem__,
)
"""The presets above, and those of plugins."""


def preset_names() -> tuple[str, ...]:
    """Every name that `preset` knows."""
    return PRESETS.names()


PresetName = Literal[preset_names()]
