"""What is rejected before a training starts: options that its method ignores, and more than fits in memory.

The least memory that a training needs is a closed form, calibrated on measured runs (docs/reliability.md). Frames are
read again when they do not fit; parameters, Adam's moments, the tracks of the first points and the buffers of one image
must be in memory at once.
"""

from __future__ import annotations

import math
from operator import attrgetter

import numpy as np

from ..core.checks import InputError, input_error
from ..core.config import Config
from ..data import FrameSequence
from ..initialization.sampling import has_surface
from ..model.basis import GIVEN
from ..model.method import method_of
from ..model.presets import preset, preset_names
from ..system.memory import available_bytes
from .gaussian_method import GaussianMethod


def reject_ignored_options(cfg: Config) -> None:
    """Raise InputError for an option that the method of a config does not use; it names the only value to take."""
    method = method_of(cfg)
    only = dict(method.only)
    if isinstance(method, GaussianMethod):
        only |= {} if method.uses_prior else {"temporal.weight": 0.0}  # the term weighs Gaussians by the prior
        only |= {} if method.starts_from_flow else {"init.motion": "rest"}
    for name, value in only.items():
        got = attrgetter(name)(cfg)
        if got != value:
            if cfg.method in preset_names() and attrgetter(name)(preset(cfg.method)) == value:
                fix = f"Start from --preset {cfg.method}, without --{name.replace('_', '-')}."
            else:  # its author is asking, whose preset has it
                own = ", or derive the method from endoprior.training.own_method.OwnMethod"
                fix = f"Set {name} to {value} in the code of its preset{own if name == 'init.motion' else ''}."
            raise input_error(name, f"{value} with method {cfg.method}, which does not use it", str(got), fix)


def note_on_budget(cfg: Config) -> str | None:
    """A line for the user if `init.budget` was set and has no effect; not an error, as benchmark specs set it."""
    has_gaussians, share = _start(cfg)
    usual = preset(cfg.method) if cfg.method in preset_names() else cfg
    if (has_gaussians and not share) or cfg.init.budget == usual.init.budget:
        return None
    start = "starts from the pixels of frames" if has_gaussians else "has no Gaussians"
    return f"init.budget {cfg.init.budget} (--gaussians) has no effect: {cfg.method} {start}"


FLOAT = 4
PICTURE_BYTES = 150  # per pixel: a decoded frame, its prior, a rendered image and its gradients
MIN_BYTES = 300 * 2**20  # compiled kernels, lists of the renderer, buffers of the libraries
MOMENTS = 2  # Adam keeps two numbers of each parameter
TRACK_BYTES = 64  # per point and frame while motion is fitted: pixel, position and offset in float64


def first_count(sequence: FrameSequence, cfg: Config) -> int:
    """Gaussians that training starts with, about; 0 for a method that has none."""
    has_gaussians, share = _start(cfg)
    if not has_gaussians or not share:
        return cfg.init.budget if has_gaussians else 0
    first = sequence.frame(sequence.indices("train")[0])
    return round(share * np.count_nonzero(first.tissue_mask & has_surface(first)))


def _start(cfg: Config) -> tuple[bool, float]:
    """Whether the method of a config has Gaussians, and its `first_share`."""
    method = method_of(cfg)
    return method.has_gaussians, method.first_share if isinstance(method, GaussianMethod) else 0.0


def least_bytes(cfg: Config, num: int, num_train: int, width: int, height: int) -> int:
    """Memory that training needs beyond what the process uses already, with `num` first Gaussians.

    Args:
        cfg: fitted to the sequence (`Method.fitted`). width, height: of its `num_train` frames, px.
    """
    schema = method_of(cfg).schema(cfg)
    sizes = {
        name: FLOAT * math.prod(length if isinstance(length, int) else num for length in spec.shape)
        for name, spec in schema.items()
    }
    gaussians = [size for name, size in sizes.items() if name.startswith("gaussians.")]
    fields = [size for name, size in sizes.items() if name.startswith("field.")]
    given = sum(sizes.get(f"gaussians.{name}", 0) for name in GIVEN)  # has no moments
    state = (1 + MOMENTS) * sum(gaussians + fields) - MOMENTS * given
    # Growing and pruning copy a tensor twice; tracks are there before the moments are.
    growing, motion = 2 * max(gaussians, default=0), sizes.get("gaussians.motion", 0)
    tracks = TRACK_BYTES * num_train * num + motion if cfg.init.motion == "flow" and motion else 0
    return MIN_BYTES + PICTURE_BYTES * width * height + max(state + growing, tracks)


def reject_too_large(sequence: FrameSequence, cfg: Config) -> None:
    """Raise InputError, with both numbers, for a training that needs more than the free memory."""
    free = available_bytes()
    camera, num_train, num = sequence.camera(0), len(sequence.indices("train")), first_count(sequence, cfg)
    least = least_bytes(method_of(cfg).fitted(cfg, len(sequence)), num, num_train, camera.width, camera.height)
    if free is None or least <= free:
        return
    fewer = ", --gaussians" if num == cfg.init.budget else ""
    raise InputError(
        f"{sequence.path}: expected memory for {len(sequence):,} frames of {camera.width}x{camera.height} px"
        f"{f' and {num:,} Gaussians' if num else ''}, at least {least / 1e9:.1f} GB; got {free / 1e9:.1f} GB free. "
        f"Free some, or ask for less: --data.shrink 2, --data.stride 2{fewer}."
    )
