"""The largest scale of a Gaussian, from its distance to the camera: what keeps a model free of fog from other sides.

A Gaussian that spans much of the picture costs the loss nothing where the camera looks from, and hangs before the
tissue as soon as the camera turns.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ..core.types import Camera


def limit_scales(log_scales: Tensor, means: Tensor, camera: Camera, share: float) -> None:
    """Lower `log_scales` in place to the log of `share` of the distance to the camera.

    Called after every step, with the camera of its frame, so that the nearest camera of the sequence decides.

    Args:
        log_scales: (N, 3) log of mm. means: (N, 3) centers in world axes, mm. share: above 0.
    """
    center = torch.as_tensor(camera.center).to(means)
    largest = (share * (means - center).norm(dim=1)).clamp(min=torch.finfo(means.dtype).tiny).log()
    torch.minimum(log_scales, largest[:, None], out=log_scales)
