"""Truth from other sides: pictures and depth of the tissue from cameras beside the endoscope.

Only tissue that the endoscope sees in the same frame is kept, as bright as the endoscope sees it: light, highlights and
the shading of the lens stay where they are on the tissue. A model learned from the endoscope's pictures, whose color
does not depend on the direction, can then be right in every kept pixel; what a real camera would see, none can know.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from .config import PhantomConfig
from .eye import Eye
from .raster import FAR
from .sensor import develop, vignette_at
from .visibility import visible_points

TURNS_DEG = {"left20": -20.0, "left10": -10.0, "right10": 10.0, "right20": 20.0}
"""Cameras turned about a vertical axis through the scene, by name."""
ASIDE_MM = {"aside15": 15.0}
"""Cameras moved to the right, looking straight on, by name."""


def side_eyes(pivot_mm: float) -> dict[str, Eye]:
    """The side cameras by name.

    Args:
        pivot_mm: distance of the axis of turning from the endoscope, on its optical axis.
    """
    pivot = np.array([0.0, 0.0, pivot_mm])
    eyes = {}
    for name, degrees in TURNS_DEG.items():
        # A camera to the right looks back to the left: its z axis turns towards -x.
        angle = -np.deg2rad(degrees)
        turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        eyes[name] = Eye(pivot - turn @ pivot, turn)
    return eyes | {name: Eye.moved(mm) for name, mm in ASIDE_MM.items()}


def side_picture(
    radiance: NDArray[np.float32],
    z: NDArray[np.float32],
    eye: Eye,
    front_z: NDArray[np.float32],
    tool: NDArray[np.bool_],
    gain: float,
    cfg: PhantomConfig,
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """The noise-free picture of one side camera and its depth; both 0 where the endoscope does not see the tissue.

    Args:
        radiance: (H, W, 3) linear. z: (H, W) mm, `FAR` where there is no surface. Both as the side camera sees them.
        front_z: (H, W) mm and tool: (H, W) mask, as the endoscope sees them.
        gain: exposure.
    Returns:
        (H, W, 3) 0..255 and (H, W) mm.
    """
    y, x = np.mgrid[: cfg.height, : cfg.width].astype(np.float64) + 0.5
    rays = np.stack([(x - cfg.center[0]) / cfg.focal, (y - cfg.center[1]) / cfg.focal, np.ones_like(x)], -1)
    points = (rays * np.where(z < FAR, z, 1)[..., None]) @ eye.turn.T + eye.center
    seen = (z < FAR) & (points[..., 2] > 0)
    points[~seen] = (0, 0, 1)
    seen &= visible_points(points, front_z, tool, cfg)
    across = cfg.focal * points[..., 0] / points[..., 2] + cfg.center[0]
    down = cfg.focal * points[..., 1] / points[..., 2] + cfg.center[1]
    lens = vignette_at(across / cfg.width, down / cfg.height).astype(np.float32)[..., None]
    picture = np.round(develop(radiance, gain, lens)).astype(np.uint8)
    # Samples of a pixel on a silhouette see different surfaces.
    inner = cv2.erode(seen.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0) > 0
    return np.where(inner[..., None], picture, 0), np.where(inner, z, 0).astype(np.float32)
