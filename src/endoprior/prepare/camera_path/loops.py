"""Loop closure: keyframes that show the same place at different times share points, so that the path cannot drift."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .follow import Follower
from .keyframes import Keyframe, link
from .residuals import back_projected

OVERLAP = 0.3
"""Least share of an old keyframe's points that lies in the new image."""
SHARED = 0.3
"""Keyframes that share more of their tracks than this need no loop."""
PARTNERS = 3
"""Old keyframes that each new one is matched with at most."""


def close_loops(follower: Follower, keyframes: list[Keyframe], size: tuple[int, int]) -> int:
    """Match keyframes of one world with older ones of the same place; matched keypoints become tracks.

    Args:
        size: (width, height) of the images, px.
    Returns:
        Pairs that match.
    """
    tracks, lens, found = follower.tracks, follower.lens, 0
    points = [
        back_projected(
            lens.matrix, follower.poses[k.frame], k.pixels.astype(np.float64), k.depths * follower.scales[k.frame]
        )
        for k in keyframes
    ]
    ids = [tracks.ids[k.frame] for k in keyframes]
    for b, new in enumerate(keyframes):
        overlap = np.array([_share_inside(lens.matrix, follower.poses[new.frame], points[a], size) for a in range(b)])
        partners: list[int] = []
        for a in np.argsort(-overlap, kind="stable"):
            if len(partners) == PARTNERS or overlap[a] < OVERLAP:
                break
            shared = len(np.intersect1d(ids[a], ids[b])) / max(min(len(ids[a]), len(ids[b])), 1)
            if shared < SHARED and all(abs(a - other) > 2 for other in partners):
                partners.append(int(a))
        for a in partners:
            old = keyframes[a]
            match = link(lens, old, follower.poses[old.frame], follower.scales[old.frame], new)
            if match is None:
                continue
            found += 1
            fresh = old.track[match.old] < 0
            old.track[match.old[fresh]] = tracks.add_points(points[a][match.old[fresh]], keypoint=True)
            _see(follower, old, match.old[fresh])
            unseen = new.track[match.new] < 0
            new.track[match.new[unseen]] = old.track[match.old[unseen]]
            _see(follower, new, match.new[unseen])
    return found


def _see(follower: Follower, key: Keyframe, which: NDArray[np.intp]) -> None:
    follower.tracks.see(key.frame, key.track[which], key.pixels[which], key.depths[which])


def _share_inside(matrix: NDArray, pose: NDArray, points: NDArray, size: tuple[int, int]) -> float:
    """Share of points (N, 3) that lie in the image."""
    seen = points @ pose[:3, :3].T + pose[:3, 3]
    z = np.maximum(seen[:, 2], 1e-6)
    u, v = matrix[0, 0] * seen[:, 0] / z + matrix[0, 2], matrix[1, 1] * seen[:, 1] / z + matrix[1, 2]
    inside = (seen[:, 2] > 0) & (u >= 0) & (v >= 0) & (u < size[0]) & (v < size[1])
    return float(inside.mean()) if len(inside) else 0.0
