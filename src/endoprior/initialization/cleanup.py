"""Clean-up of a point cloud: voxel downsampling and outlier removal. `N` points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree


@dataclass(frozen=True)
class PointCloud:
    """Colored points."""

    points: NDArray[np.float32]
    """(N, 3) world coordinates, mm."""
    colors: NDArray[np.float32]
    """(N, 3) red, green, blue in [0, 1]."""
    origins: NDArray[np.int32]
    """(N,) position of the source frame of each point in the list of sampled frames."""

    def __len__(self) -> int:
        return len(self.points)

    def subset(self, rows: NDArray) -> PointCloud:
        """The points selected by `rows`, indices or a mask."""
        return PointCloud(self.points[rows], self.colors[rows], self.origins[rows])


def concatenated(clouds: list[PointCloud]) -> PointCloud:
    """One cloud of all points; an empty list gives an empty cloud."""
    empty = PointCloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32), np.zeros(0, np.int32))
    parts = [(cloud.points, cloud.colors, cloud.origins) for cloud in clouds or [empty]]
    return PointCloud(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def merge_voxels(cloud: PointCloud, divisions: int) -> PointCloud:
    """Replace the points of each voxel by their mean position and mean color.

    Args:
        cloud: finite points.
        divisions: number of voxels along the longest side of the bounding box, whose corner is the center of a voxel.
    Returns:
        One point per occupied voxel, ordered by voxel (x, then y, then z), with the origin of its first point.
    """
    if len(cloud) == 0:
        return cloud
    points = cloud.points.astype(np.float64)
    low = points.min(0)
    side = (points.max(0) - low).max() / divisions
    if side == 0:  # all points coincide
        color = cloud.colors.mean(0, dtype=np.float64, keepdims=True).astype(np.float32)
        return PointCloud(cloud.points[:1], color, cloud.origins[:1])
    voxel = np.floor((points - low) / side + 0.5).astype(np.int64)
    _, first, owner, count = np.unique(voxel, axis=0, return_index=True, return_inverse=True, return_counts=True)
    owner = owner.reshape(-1)

    def mean(values: NDArray[np.floating]) -> NDArray[np.float32]:
        sums = [np.bincount(owner, values[:, c], len(count)) for c in range(3)]
        return (np.stack(sums, -1) / count[:, None]).astype(np.float32)

    return PointCloud(mean(points), mean(cloud.colors), cloud.origins[first])


def remove_outliers(cloud: PointCloud, num_neighbors: int, num_std: float) -> PointCloud:
    """Remove points whose mean distance to their neighbors is unusually large.

    Args:
        cloud: finite points.
        num_neighbors: number of nearest points in the mean, including the point itself (distance 0).
        num_std: points above the mean plus this many standard deviations are removed.
    Returns:
        The other points, in order; the cloud itself if it has at most `num_neighbors` points.
    """
    if len(cloud) <= num_neighbors:
        return cloud
    distance, _ = cKDTree(cloud.points).query(cloud.points, k=num_neighbors)
    average = distance.reshape(len(cloud), -1).mean(1)
    keep = average <= average.mean() + num_std * average.std(ddof=1)
    return cloud.subset(keep)
