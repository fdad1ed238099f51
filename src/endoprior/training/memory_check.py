"""The least memory that a training needs, so that one that cannot succeed is rejected at once, with a number.

Closed form, calibrated on measured runs (docs/reliability.md). Frames are read again when they do not fit; parameters,
Adam's moments, the tracks of the first points and the buffers of one image must be in memory at once.
"""

from __future__ import annotations

import math

from ..core.checks import InputError
from ..core.config import Config
from ..data import FrameSequence
from ..model.method import method_of
from ..system.memory import available_bytes

FLOAT = 4
PICTURE_BYTES = 150
"""Per pixel: a decoded frame, its prior, a rendered image and its gradients."""
LEAST_BYTES = 300 * 2**20
"""Compiled kernels, lists of the renderer, buffers of the libraries."""
MOMENTS = 2
"""Adam keeps two numbers of each parameter."""
TRACK_BYTES = 64
"""Per point and frame while motion is fitted: pixel, position and offset in float64."""


def least_bytes(cfg: Config, num_train: int, width: int, height: int) -> int:
    """Memory that training needs beyond what the process uses already.

    Args:
        cfg: fitted to the sequence (`Config.fitted`).
        num_train: training frames.
        width, height: of a frame, px.
    """
    num = cfg.init.budget
    sizes = {
        name: FLOAT * math.prod(num if length == "N" else length for length in spec.shape)
        for name, spec in method_of(cfg).schema(cfg).items()
        if name.startswith(("gaussians.", "field."))
    }
    motion = sizes.get("gaussians.motion", 0)
    state = (1 + MOMENTS) * sum(sizes.values())
    # Growing and pruning copy a tensor twice; tracks are there before the moments are.
    growing = 2 * max((size for name, size in sizes.items() if name.startswith("gaussians.")), default=0)
    tracks = TRACK_BYTES * num_train * num + motion if cfg.init.motion == "flow" and motion else 0
    return LEAST_BYTES + PICTURE_BYTES * width * height + max(state + growing, tracks)


def reject_too_large(sequence: FrameSequence, cfg: Config) -> None:
    """Reject a training that the free memory cannot hold.

    Raises:
        InputError: it needs more than there is; with both numbers.
    """
    free = available_bytes()
    camera, num_train = sequence.camera(0), len(sequence.indices("train"))
    least = least_bytes(cfg.fitted(len(sequence)), num_train, camera.width, camera.height)
    if free is None or least <= free:
        return
    raise InputError(
        f"{sequence.path}: expected memory for {len(sequence):,} frames of {camera.width}x{camera.height} px and "
        f"{cfg.init.budget:,} Gaussians, at least {least / 1e9:.1f} GB; got {free / 1e9:.1f} GB free. Free some, or "
        "ask for less: --data.shrink 2, --data.stride 2, --gaussians."
    )
