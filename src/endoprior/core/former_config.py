"""Configs that earlier versions stored: their fields become those of today, or are constants now.

A number that is a constant now must have had its value, else the run cannot go on bit-identically; that is said.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Collection, Iterator, Mapping
from typing import Any

from .checks import input_error, printable

Values = Mapping[str, Any]
"""Values of a config by dotted name."""
GONE = ("poses", "loss.fit_relative_depth", "radiance")
"""Fields and groups of which nothing is left, whatever their value."""
CONSTANTS: dict[str, Any] = {
    "data.depth_clip_low_percentile": 3.0,
    "data.depth_clip_high_percentile": 99.8,
    "prior.specular.value_threshold": 0.85,
    "prior.specular.saturation_threshold": 0.35,
    "prior.specular.value_temperature": 0.04,
    "prior.specular.saturation_temperature": 0.08,
    "prior.specular.clip_threshold": 0.92,
    "prior.salience.percentile": 99.0,
    "init.uniform_fraction": 0.45,
    "init.erosion_px": 9,
    "init.salience_border": "reflect",
    "init.pool_fraction": 0.01,
    "init.voxel_divisions": 400,
    "init.outlier_neighbors": 20,
    "init.outlier_std": 1.5,
    "deformation.hexplane.resolution": [64, 64, 64],
    "deformation.hexplane.width": 32,
    "deformation.hexplane.learn_box": True,
    "deformation.hexplane.time_map": "raw",
    "deformation.basis.frames_per_basis": 1.8,
    "deformation.basis.relative_width": 1.5,
    "deformation.basis.deform_color": True,
    "loss.depth_mode": "accumulated",
    "loss.min_depth_pixels": 10,
    "temporal.displacement_weight": 1.0,
    "temporal.num_neighbors": 8,
    "temporal.huber_delta": 0.01,
    "temporal.motion_threshold": 0.45,
    "temporal.motion_temperature": 0.08,
    "temporal.min_effective": 256,
    "density.clone_extent": 0.01,
    "density.extent_mode": "camera",
    "density.split_shrink": 1.6,
    "density.prior_opacity": 0.0075,
    "density.max_gaussians": 200_000,
    "optim.network_lr": 1.6e-4,
    "optim.network_lr_final": 1.6e-6,
    "optim.planes_lr": 1.6e-3,
    "optim.planes_lr_final": 1.6e-5,
    "optim.basis_opacity_lr": 2e-2,
    "optim.basis_decay": 0.1,
    "optim.sh_dc_lr": 2.5e-3,
    "optim.sh_rest_lr": 1.25e-4,
    "optim.color_slopes_lr": 2.5e-3,
    "optim.opacity_lr": 5e-2,
    "optim.epsilon": 1e-15,
    "optim.basis_epsilon": 1e-7,
    "optim.still_camera_scale": 10.0,
    "windows.turn_degrees": 15.0,
    "windows.shift_share": 0.1,
    "windows.picture_change": 0.05,
    "windows.shortest": 40,
    "windows.overlap": 20,
}
"""Former field -> its value for good."""
OF_METHODS = (
    "optim.network_lr", "optim.network_lr_final", "optim.planes_lr", "optim.planes_lr_final",
    "deformation.hexplane.width", "deformation.hexplane.learn_box", "density.clone_extent",
)  # fmt: skip
"""Constants that other methods replace by their own."""
DECIDES = (
    "deformation.hexplane.resolution", "deformation.hexplane.time_map", "deformation.basis.relative_width",
    "deformation.basis.deform_color",
)  # fmt: skip
"""Constants without which a trained scene cannot be rendered."""


def _moved(old: dict[str, Any]) -> dict[str, Any]:
    """The fields of today that former ones have become."""
    pairs, distance = old.get("temporal.pair_weights", True), old.get("temporal.distance_weight")
    found = {
        "released.prior": ("density.score_mode", old.get("density.score_mode") == "events"),
        "released.cleanup": ("init.cleanup", old.get("init.cleanup")),
        "released.half_pixel_shift": ("init.pixel_offset", old.get("init.pixel_offset") == "legacy"),
        "released.zero_biases": (
            "deformation.hexplane.bias_init",
            old.get("deformation.hexplane.bias_init") == "zero",
        ),
        "released.prune_max_scale_mm": ("density.prune_max_scale_mm", old.get("density.prune_max_scale_mm")),
        "deformation.deform_shape": ("deformation.deform_scales", old.get("deformation.deform_scales")),
        "temporal.without": (
            "temporal.pair_weights",
            "pair_weights" if not pairs else "distance" if distance == 0 else "nothing",
        ),
        "schedule.literal": ("schedule.half_resolution_iterations", _is_literal(old)),
        "windows.longest": ("windows.enabled", old.get("windows.longest", 200) if old.get("windows.enabled") else 0),
    }
    if old.get("deformation.kind") != "hexplane":
        found["optim.basis_lr"] = ("optim.basis_means_lr", old.get("optim.basis_means_lr"))
    return {name: value for name, (former, value) in found.items() if former in old}


def _is_literal(stored: Values) -> bool:
    """Whether a stored config follows a publication: only those trained at full resolution throughout."""
    return stored.get("schedule.literal", stored.get("schedule.half_resolution_iterations") == 0)


def _former_values(new: Values) -> dict[str, Any]:
    """Every former field with the value that the fields of today give it."""
    released, without, both = (
        new.get("released.prior"),
        new.get("temporal.without"),
        new.get("temporal.gradient") == "both",
    )
    shape, basis = new.get("deformation.deform_shape"), new.get("optim.basis_lr")
    change, rate = new.get("deformation.max_scale_change"), new.get("optim.means_lr")
    return CONSTANTS | {
        "prior.salience.border": "zero" if released else "reflect",
        "init.adaptive_specular": bool(released),
        "init.salience_on_eroded_mask": bool(released),
        "init.cleanup": new.get("released.cleanup"),
        "init.pixel_offset": "legacy" if new.get("released.half_pixel_shift") else "exact",
        "deformation.hexplane.bias_init": "zero" if new.get("released.zero_biases") else "default",
        "deformation.deform_scales": shape,
        "deformation.deform_quats": shape,
        "loss.tv_on_tissue": not new.get("loss.cover_weight"),
        "temporal.distance_weight": 0.0 if without == "distance" else 0.2,
        "temporal.pair_weights": without != "pair_weights",
        "temporal.valid_at_both": both,
        "temporal.max_points": 0 if both else 1024,
        "temporal.huber_scale": "released" if released else "literal",
        "temporal.adaptive_motion_weight": bool(released),
        "temporal.refill": bool(released),
        "density.prune_max_scale_mm": new.get("released.prune_max_scale_mm"),
        "density.prior_prune": new.get("density.min_densify_weight") != 1,
        "density.score_mode": "events" if released else "every",
        "density.unobserved_score": 1.0 if released else 0.0,
        "density.max_scale_share": 0.025 if isinstance(change, float) and change > 1 else 0.0,
        "optim.means_lr_final": float(f"{rate / 100:.12g}") if isinstance(rate, float) else None,
        **{f"optim.basis_{name}_lr": basis for name in ("means", "quats", "log_scales", "color")},
        "windows.enabled": new.get("windows.longest") != 0,
    }


def _completed(stored: dict[str, Any]) -> dict[str, Any]:
    """A stored config with the fields that it had no choice of: what was trained before there was one."""
    if _is_literal(stored):
        stored = {"data.reliability": "ignored"} | stored
    if "render.depth_grad_to_means" in stored:  # a whole group, as runs store it
        stored = {"render.photometric": "none"} | stored
    return stored


def current_form(values: dict[str, Any], fields: Collection[str], own: bool) -> dict[str, Any]:
    """The nested values of a stored config as this version names them; one line on stderr says what is ignored.

    Args:
        fields: what the top level of the config has today.
        own: the config is one of our own method; others set `OF_METHODS` themselves.
    Raises:
        InputError: a trained scene cannot look as it did, because what decided it is a constant now.
    """
    if any("." in str(name) for name in values):
        return values  # is rejected
    stored = _completed(dict(_flat(values)))
    gone = [name for name in GONE if name not in fields and any(f"{n}.".startswith(f"{name}.") for n in stored)]
    stored = {n: value for n, value in stored.items() if not f"{n}.".startswith(tuple(f"{name}." for name in gone))}
    known = _former_values({})
    old = {name: value for name, value in stored.items() if name in known}
    if not (gone or old):
        return _nested(stored)
    new = {name: value for name, value in stored.items() if name not in known} | _moved(stored)
    if new.get("deformation.kind") == "hexplane" and old:
        new.pop("deformation.basis.num_bases", None)  # it has no effect there, and another default
    differs = []
    for name, now in _former_values(new).items():
        if name in old and old[name] != now and _matters(name, new, own):
            if name in DECIDES:
                fix = "Render this scene with the version that trained it."
                raise input_error(f"config.{name}", str(now), str(old[name])[:80], fix)
            differs.append(f"{name} is {now!s:.80} here and {old[name]!s:.80} there")
    said = [f"ignored {', '.join(gone)}, which this version does not have"] if gone else []
    if differs:
        said.append(f"{'; '.join(differs)}: a run with it does not resume bit-identically")
    elif old:
        said.append(f"{len(old)} of its fields are constants of this version, with the same values")
    print_once("; ".join(said))
    return _nested(new)


def _matters(name: str, new: Values, own: bool) -> bool:
    """Whether a former field had an effect, given the others."""
    kind = new.get("deformation.kind")
    if name in OF_METHODS and not own:
        return False
    if name.startswith(("deformation.hexplane.", "optim.network", "optim.planes")):
        return kind == "hexplane"
    if name.startswith(("deformation.basis.", "optim.basis_")):
        moves_opacity = name != "optim.basis_opacity_lr" or bool(new.get("deformation.deform_opacity"))
        return own and kind == "basis" and moves_opacity
    return new.get("temporal.weight") != 0 if name.startswith("temporal.") else True


def _flat(values: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Values by dotted name; an empty group is a value."""
    for name, value in values.items():
        if isinstance(value, dict) and value and all(isinstance(key, str) and "." not in key for key in value):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _nested(flat: Values) -> dict[str, Any]:
    """Inverse of `_flat`."""
    nested: dict[str, Any] = {}
    for name, value in flat.items():
        *path, last = name.split(".")
        group: Any = nested
        for part in path:
            group = group.setdefault(part, {}) if isinstance(group, dict) else {}
        if isinstance(group, dict):  # else it is rejected for being none
            group[last] = value
    return nested


@functools.cache
def print_once(text: str) -> None:
    """Say something about a stored config on stderr; once per process."""
    print(printable(f"endoprior: stored config: {text}"), file=sys.stderr)
