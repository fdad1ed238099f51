"""Configs that earlier versions stored: their fields become those of today, or are ignored and named.

A number that is a constant now must have had its value, else the run cannot go on bit-identically; that is said too.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Any

from .checks import input_error, printable

Values = Mapping[str, Any]
"""Values of a config by dotted name."""

MOVED: dict[str, tuple[str, Callable[[Values], Any]]] = {
    "released.prior": ("density.score_mode", lambda old: old["density.score_mode"] == "events"),
    "released.cleanup": ("init.cleanup", lambda old: old["init.cleanup"]),
    "released.half_pixel_shift": ("init.pixel_offset", lambda old: old["init.pixel_offset"] == "legacy"),
    "released.zero_biases": (
        "deformation.hexplane.bias_init",
        lambda old: old["deformation.hexplane.bias_init"] == "zero",
    ),
    "released.prune_max_scale_mm": ("density.prune_max_scale_mm", lambda old: old["density.prune_max_scale_mm"]),
    "deformation.deform_shape": ("deformation.deform_scales", lambda old: old["deformation.deform_scales"]),
    "optim.basis_lr": ("optim.basis_means_lr", lambda old: old["optim.basis_means_lr"]),
    "temporal.without": (
        "temporal.pair_weights",
        lambda old: (
            "nothing" if old["temporal.pair_weights"] and old.get("temporal.distance_weight", 0.2)
            else "distance" if old["temporal.pair_weights"] else "pair_weights"
        ),
    ),
    "windows.longest": (
        "windows.enabled", lambda old: old.get("windows.longest", 200) if old["windows.enabled"] else 0
    ),
}  # fmt: skip
"""Field of today -> the former one that it needs, and its value."""
GONE = ("poses", "loss.fit_relative_depth", "radiance")
"""Fields and groups whatever their value, of which nothing is left."""


def _released(with_it: Any, without: Any) -> Callable[[Values], Any]:
    return lambda new: with_it if new.get("released.prior") else without


CONSTANTS: dict[str, Any] = {
    "data.depth_clip_low_percentile": 3.0,
    "data.depth_clip_high_percentile": 99.8,
    "prior.specular.value_threshold": 0.85,
    "prior.specular.saturation_threshold": 0.35,
    "prior.specular.value_temperature": 0.04,
    "prior.specular.saturation_temperature": 0.08,
    "prior.specular.clip_threshold": 0.92,
    "prior.salience.percentile": 99.0,
    "prior.salience.border": _released("zero", "reflect"),
    "init.uniform_fraction": 0.45,
    "init.erosion_px": 9,
    "init.adaptive_specular": _released(True, False),
    "init.salience_on_eroded_mask": _released(True, False),
    "init.salience_border": "reflect",
    "init.pool_fraction": 0.01,
    "init.cleanup": lambda new: new.get("released.cleanup"),
    "init.voxel_divisions": 400,
    "init.outlier_neighbors": 20,
    "init.outlier_std": 1.5,
    "init.pixel_offset": lambda new: "legacy" if new.get("released.half_pixel_shift") else "exact",
    "deformation.hexplane.resolution": [64, 64, 64],
    "deformation.hexplane.width": 32,
    "deformation.hexplane.learn_box": True,
    "deformation.hexplane.time_map": "raw",
    "deformation.hexplane.bias_init": lambda new: "zero" if new.get("released.zero_biases") else "default",
    "deformation.basis.frames_per_basis": 1.8,
    "deformation.basis.relative_width": 1.5,
    "deformation.basis.deform_color": True,
    "deformation.deform_scales": lambda new: new.get("deformation.deform_shape"),
    "deformation.deform_quats": lambda new: new.get("deformation.deform_shape"),
    "loss.depth_mode": "accumulated",
    "loss.tv_on_tissue": lambda new: not new.get("loss.cover_weight"),
    "temporal.displacement_weight": 1.0,
    "temporal.distance_weight": lambda new: 0.0 if new.get("temporal.without") == "distance" else 0.2,
    "temporal.num_neighbors": 8,
    "temporal.huber_delta": 0.01,
    "temporal.huber_scale": _released("released", "literal"),
    "temporal.motion_threshold": 0.45,
    "temporal.motion_temperature": 0.08,
    "temporal.adaptive_motion_weight": _released(True, False),
    "temporal.min_effective": 256,
    "temporal.pair_weights": lambda new: new.get("temporal.without") != "pair_weights",
    "temporal.valid_at_both": lambda new: new.get("temporal.gradient") == "both",
    "temporal.max_points": lambda new: 0 if new.get("temporal.gradient") == "both" else 1024,
    "temporal.refill": _released(True, False),
    "density.clone_extent": 0.01,
    "density.extent_mode": "camera",
    "density.split_shrink": 1.6,
    "density.prune_max_scale_mm": lambda new: new.get("released.prune_max_scale_mm"),
    "density.prior_prune": lambda new: new.get("density.min_densify_weight") != 1,
    "density.prior_opacity": 0.0075,
    "density.max_gaussians": 200_000,
    "density.max_scale_share": lambda new: 0.025 if _limits_scales(new) else 0.0,
    "density.score_mode": _released("events", "every"),
    "density.unobserved_score": _released(1.0, 0.0),
    "optim.means_lr_final": lambda new: _hundredth(new.get("optim.means_lr")),
    "optim.network_lr": 1.6e-4,
    "optim.network_lr_final": 1.6e-6,
    "optim.planes_lr": 1.6e-3,
    "optim.planes_lr_final": 1.6e-5,
    "optim.basis_means_lr": lambda new: new.get("optim.basis_lr"),
    "optim.basis_quats_lr": lambda new: new.get("optim.basis_lr"),
    "optim.basis_log_scales_lr": lambda new: new.get("optim.basis_lr"),
    "optim.basis_opacity_lr": lambda new: 2e-2,
    "optim.basis_color_lr": lambda new: new.get("optim.basis_lr"),
    "optim.basis_decay": 0.1,
    "optim.sh_dc_lr": 2.5e-3,
    "optim.sh_rest_lr": 1.25e-4,
    "optim.color_slopes_lr": 2.5e-3,
    "optim.opacity_lr": 5e-2,
    "optim.epsilon": 1e-15,
    "optim.basis_epsilon": 1e-7,
    "optim.still_camera_scale": 10.0,
    "windows.enabled": lambda new: new.get("windows.longest") != 0,
    "windows.turn_degrees": 15.0,
    "windows.shift_share": 0.1,
    "windows.picture_change": 0.05,
    "windows.shortest": 40,
    "windows.overlap": 20,
}
"""Former field -> the value that it has for good, or that today's fields give it."""
OF_METHODS = (
    "optim.network_lr", "optim.network_lr_final", "optim.planes_lr", "optim.planes_lr_final",
    "deformation.hexplane.width", "deformation.hexplane.learn_box", "density.clone_extent",
)  # fmt: skip
"""Constants that other methods replace by their own."""
DECIDES = ("deformation.basis.relative_width", "deformation.hexplane.time_map", "deformation.hexplane.resolution")
"""Constants without which a trained scene cannot be rendered."""


def current_form(values: dict[str, Any], fields: Collection[str], own: bool) -> dict[str, Any]:
    """The nested values of a stored config as this version names them; one line on stderr says what is ignored.

    Args:
        fields: what the top level of the config has today.
        own: the config is one of our own method; others set `OF_METHODS` themselves.
    Raises:
        InputError: a trained scene cannot look as it did, because what decided it is a constant now.
    """
    flat = dict(_flat(values))
    gone = [name for name in GONE if name not in fields and any(f"{found}.".startswith(f"{name}.") for found in flat)]
    flat = {found: value for found, value in flat.items() if not f"{found}.".startswith(tuple(f"{n}." for n in gone))}
    old = {name: flat.pop(name) for name in CONSTANTS if name in flat}
    if not (gone or old):
        return values
    for name, (needs, value_of) in MOVED.items():
        if needs in old:
            flat[name] = value_of(old | flat)
    if flat.get("deformation.kind") == "hexplane" and any(name.startswith("optim.basis_") for name in old):
        flat.pop("optim.basis_lr", None)  # which have no effect there, and another default
        flat.pop("deformation.basis.num_bases", None)
    differs = []
    for name, value in old.items():
        now = CONSTANTS[name](flat) if callable(CONSTANTS[name]) else CONSTANTS[name]
        if value != now and _matters(name, flat, own):
            if name in DECIDES:
                fix = "Render this scene with the version that trained it."
                raise input_error(f"config.{name}", str(now), str(value)[:80], fix)
            differs.append(f"{name} is {now!s:.80} here and {value!s:.80} there")
    said = [f"ignored {', '.join(gone)}, which this version does not have"] if gone else []
    if differs:
        said.append(f"{'; '.join(differs)}: a run with it does not resume bit-identically")
    elif old:
        said.append(f"{len(old)} of its fields are constants of this version, with the same values")
    print_once("; ".join(said))
    return _nested(flat)


def _matters(name: str, new: Values, own: bool) -> bool:
    """Whether a former field had an effect, given the others."""
    kind = new.get("deformation.kind")
    if name in OF_METHODS and not own:
        return False
    if name.startswith(("deformation.hexplane.", "optim.network", "optim.planes")):
        return kind == "hexplane"
    if name == "optim.basis_opacity_lr":
        return kind == "basis" and bool(new.get("deformation.deform_opacity"))
    if name.startswith(("deformation.basis.", "optim.basis_")):
        return own and kind == "basis"
    return new.get("temporal.weight") != 0 if name.startswith("temporal.") else True


def _flat(values: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Values by dotted name; an empty group is a value."""
    for name, value in values.items():
        if isinstance(value, dict) and value and all(isinstance(key, str) for key in value):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _nested(flat: Values) -> dict[str, Any]:
    """Inverse of `_flat`."""
    nested: dict[str, Any] = {}
    for name, value in flat.items():
        *path, last = name.split(".")
        group = nested
        for part in path:
            group = group.setdefault(part, {})
        group[last] = value
    return nested


@functools.cache
def print_once(text: str) -> None:
    """Say something about a stored config on stderr; once per process."""
    print(printable(f"endoprior: stored config: {text}"), file=sys.stderr)


def _limits_scales(new: Values) -> bool:
    limit = new.get("deformation.max_scale_change")
    return isinstance(limit, float) and limit > 1


def _hundredth(value: Any) -> Any:
    return float(f"{value / 100:.12g}") if isinstance(value, float) else None
