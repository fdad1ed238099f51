"""Named configs: functions that return one. Every departure is listed, with its reason, in `docs/paper_map.md`.

Those of other methods are entry points of the group `endoprior.presets`.
"""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any, Literal

from ..core.checks import input_error, or_did_you_mean
from ..core.config import Config, ReleasedMethod
from ..system.plugins import Registry


def preset(name: str = "default", **changes: Any) -> Config:
    """The config of a preset: `preset("default", iterations=3000, seed=1)`.

    Args:
        changes: other values, by names that `Config.replace` knows; `iterations` changes the whole schedule,
            `gaussians` is how many there are at the start: training may add more and remove some.
    Raises:
        InputError: no preset or field has this name, or a value has the wrong type or range.

    Example:
        >>> import endoprior
        >>> endoprior.preset("default", seed=1, gaussians=10_000).init.budget
        10000
    """
    if name not in preset_names():
        fix = or_did_you_mean("choose one of them.", name, preset_names())
        raise input_error("preset", f"one of {', '.join(preset_names())}", repr(name), fix)
    made = PRESETS.load(name)()
    return made.replace(changes) if changes else made


def default() -> Config:
    """What we recommend.

    The paper's prior, and motion as temporal coefficients of each Gaussian, seeded by flow.

    Its rates suit 1,350 iterations: those of 3DGS are meant for twenty times as many.
    """
    return Config()


def paper() -> Config:
    """The paper's equations and constants, literally. EndoGaussian's choices where the paper is silent."""
    base = Config()
    return replace(
        base,
        data=replace(base.data, reliability="ignored"),
        init=replace(
            base.init,
            budget=20_000,
            variance_factor=1.0,
            thickness=1.0,
            opacity=0.1,
            fill_unseen=False,
            motion="rest",
        ),
        deformation=replace(base.deformation, kind="hexplane", max_scale_change=0.0),
        render=replace(base.render, depth_grad_to_means=False, color_slopes=False, photometric="none"),
        loss=replace(
            base.loss,
            depth_weight=1.0,
            edge_weight=0.0,
            tv_weight=0.03,
            cover_weight=0.0,
            track_weight=0.0,
            trust_masks=True,
        ),
        temporal=replace(base.temporal, start_iteration=1000, min_valid=20, gradient="both"),
        density=replace(base.density, grow_threshold=2e-4, start_iteration=500),
        optim=replace(
            base.optim, means_lr=1.6e-4, scales_lr=5e-3, quats_lr=1e-3, decay_iterations=4000, late_decay=1.0
        ),
        schedule=replace(
            base.schedule,
            coarse_iterations=1000,
            fine_iterations=3000,
            half_resolution_iterations=0,
            sh_degree=3,
            literal=True,
        ),
        windows=replace(base.windows, longest=0),
    )


def released() -> Config:
    """The authors' released code, where it differs from the paper."""
    base = paper()
    return replace(
        base,
        data=replace(base.data, lift_missing_depth=True),
        init=replace(base.init, variance_factor=0.4),
        deformation=replace(base.deformation, deform_opacity=True),
        temporal=replace(base.temporal, min_valid=1, gradient="current"),
        optim=replace(base.optim, decay_iterations=3000),
        released=ReleasedMethod(
            prior=True, cleanup=True, half_pixel_shift=True, zero_biases=True, prune_max_scale_mm=40.0
        ),
    )


def endogaussian() -> Config:
    """The paper's baseline: no prior, plain 3DGS density control. Conference version, with pool sampling."""
    base = paper()
    return replace(
        base,
        data=replace(base.data, lift_missing_depth=True),
        init=replace(base.init, sampler="pool", budget=30_000),
        density=replace(base.density, min_densify_weight=1.0),
        temporal=replace(base.temporal, weight=0.0),
        released=ReleasedMethod(half_pixel_shift=True),
    )


def best() -> Config:
    """`default`, given time. Twice its iterations and nearly twice its Gaussians."""
    base = default()
    return replace(
        base,
        init=replace(base.init, budget=50_000),
        density=replace(base.density, grow_threshold=2e-4),
        optim=replace(base.optim, decay_iterations=2700),
        schedule=replace(base.schedule, fine_iterations=2700, half_resolution_iterations=720),
    )


def preview() -> Config:
    """A first look at small frames, not for scores. `default` with a third of its Gaussians and iterations."""
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


def preset_line(name: str) -> str:
    """What a preset is, in a few words: the first sentence of its documentation."""
    text = OWN_PRESETS[name].__doc__ if name in OWN_PRESETS else PRESETS.documentation(name)
    return re.split(r"(?<=\w)\.(?:\s|$)", text or "", maxsplit=1)[0]


def preset_names() -> tuple[str, ...]:
    """Every name that `preset` knows."""
    return PRESETS.names()


PresetName = Literal[preset_names()]
