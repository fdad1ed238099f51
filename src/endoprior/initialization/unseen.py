"""Points where no frame shows tissue: behind tools that stand still, and where depth is missing.

Without them a scene has holes there, black from the front and open from the side. Each frame is cut into cells. A cell
without measured tissue, into which no point of another frame has moved, gets a point: color and inverse depth continue
those around it smoothly (Laplace's equation), and it moves as the points around it do. Cells beyond the convex hull of
all tissue, such as the corners around a round picture, stay empty.

Letters: `T` training frames, `N` points, `M` new ones, `B` basis functions, `R, C` rows and columns of cells.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import spsolve
from scipy.spatial import KDTree

from ..core.config_deformation import BasisConfig
from ..core.geometry import back_project, cells_at, project
from ..core.types import Frame
from ..model.basis import spline_weights
from .motion_fit import InitialMotion
from .neighbor_motion import CARRIERS, weights_by_distance
from .sampling import PointCloud, concatenated, eroded_mask, has_surface

CELLS = 80  # columns of cells: one for 8 px of an image 640 px wide
RIM_PX = 9  # width of the rim along tools, in px of an image 640 px wide, whose color and depth are not continued


def unseen_points(
    frames: Sequence[Frame], cloud: PointCloud, motion: InitialMotion | None, cfg: BasisConfig
) -> tuple[PointCloud, InitialMotion | None]:
    """New points; and the motion of all, theirs last: they move as those around them.

    Args:
        frames: the T training frames that the cloud comes from.
        motion: of its points; None: nothing moves.
    """
    size = _cell_size(frames[0])
    within = convex_hull(np.any([_cell_sums(frame.tissue_mask, size) > 0 for frame in frames], axis=0))
    found, motions = list[PointCloud](), list[InitialMotion]()
    for position, frame in enumerate(frames):
        weights = spline_weights(frame.time, cfg.num_bases)
        moved = cloud.points if motion is None else cloud.points + motion.displacement(weights, position)
        added = [part.points for part in found]
        if motion is not None:
            added = [points + its.displacement(weights, position) for points, its in zip(added, motions, strict=True)]
        new, colors = _fill(frame, np.concatenate([moved, *added]), within)
        if not len(new):
            continue
        points = new
        if motion is not None:
            distances, nearest = KDTree(moved).query(new, k=min(CARRIERS, len(moved)))
            near = weights_by_distance(np.reshape(distances, (len(new), -1)).astype(np.float64))
            motions.append(motion.carried(np.reshape(nearest, (len(new), -1)), near))
            points = new - motions[-1].displacement(weights, position)
        origins = np.full(len(new), position, np.int32)
        found.append(PointCloud(points.astype(np.float32), colors.astype(np.float32), origins))
    return concatenated(found), motion and InitialMotion.joined([motion, *motions])


def _cell_size(frame: Frame) -> int:
    """Side of a cell, px."""
    return max(round(frame.camera.width / CELLS), 2)


def convex_hull(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(R, C) True in the convex hull of the centers of all True pixels of `mask` (R, C)."""
    inside = np.zeros(mask.shape, np.uint8)
    rows = np.flatnonzero(mask.any(1))
    if len(rows):
        first, last = mask[rows].argmax(1), mask.shape[1] - 1 - mask[rows, ::-1].argmax(1)
        ends = np.concatenate([np.stack([first, rows], -1), np.stack([last, rows], -1)])
        cv2.fillConvexPoly(inside, cv2.convexHull(ends.astype(np.int32)), 1)
    return inside > 0


def _fill(frame: Frame, points: NDArray, within: NDArray[np.bool_]) -> tuple[NDArray, NDArray]:
    """New points (M, 3) and their colors (M, 3) for one frame.

    They lie in the cells `within` (R, C) which neither measured tissue nor one of the `points` (N, 3) covers.
    """
    camera, size = frame.camera, _cell_size(frame)
    measured = frame.tissue_mask & has_surface(frame)
    rim = max(round(RIM_PX * camera.width / 640), 1)
    shown = _cell_sums(measured, size) > 0
    pixels, z = project(points.astype(np.float64), camera)
    inside = (z > 0) & (pixels >= 0).all(1) & (pixels < (camera.width, camera.height)).all(1)
    x, y = cells_at(pixels[inside], camera.width, camera.height)
    covered = shown | ~within
    covered[y // size, x // size] = True
    if covered.all() or not shown.any():
        return np.zeros((0, 3)), np.zeros((0, 3))
    trusted = eroded_mask(frame.tissue_mask, rim) & measured
    trusted = trusted if trusted.any() else measured
    inverse = np.divide(1.0, frame.depth, out=np.zeros(frame.depth.shape), where=trusted)
    count = _cell_sums(trusted, size)
    known = count > 0
    values = np.concatenate([frame.rgb * trusted[..., None], inverse[..., None]], -1, dtype=np.float32)
    means = _cell_sums(values, size) / np.maximum(count, 1)[..., None]
    filled = laplace_fill(means, known)
    row, column = np.nonzero(~covered)
    center = np.stack([column + 0.5, row + 0.5], -1) * size
    center = np.minimum(center, (camera.width - 0.5, camera.height - 0.5))
    return back_project(center, 1 / filled[row, column, 3], camera), filled[row, column, :3]


def _cell_sums(image: NDArray, size: int) -> NDArray[np.float32]:
    """(R, C) or (R, C, K): sums over cells of `size` x `size` pixels of (H, W) or (H, W, K); the last ones are cut."""
    height, width = image.shape[:2]
    pad = [(0, -height % size), (0, -width % size), *[(0, 0)] * (image.ndim - 2)]
    padded = np.pad(image.astype(np.float32), pad)
    cells = padded.shape[1] // size, padded.shape[0] // size
    return np.asarray(cv2.resize(padded, cells, interpolation=cv2.INTER_AREA), np.float32) * np.float32(size**2)


def laplace_fill(values: NDArray, known: NDArray[np.bool_]) -> NDArray[np.float64]:
    """(R, C, K) `values` where `known` (R, C); elsewhere each is the mean of its neighbors, up to the image's border.

    Raises:
        ValueError: nothing is known.
    """
    if not known.any():
        raise ValueError("laplace_fill: nothing is known")
    filled = np.where(known[..., None], values, 0.0)
    rows, columns = np.nonzero(~known)
    count, every = len(rows), np.arange(len(rows))
    if not count:
        return filled
    number = np.full(np.add(known.shape, 2), -2)  # -2 beyond the image, -1 where known
    number[1:-1, 1:-1] = -1
    number[rows + 1, columns + 1] = every
    right, degree, entries = np.zeros((count, values.shape[-1])), np.zeros(count), [(every, every)]
    for step_y, step_x in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        other = number[rows + 1 + step_y, columns + 1 + step_x]
        degree += other > -2
        border, inner = np.flatnonzero(other == -1), np.flatnonzero(other >= 0)
        right[border] += filled[rows[border] + step_y, columns[border] + step_x]
        entries.append((inner, other[inner]))
    own, other = (np.concatenate(part) for part in zip(*entries, strict=True))
    matrix = coo_matrix((np.concatenate([degree, -np.ones(len(own) - count)]), (own, other)), shape=(count, count))
    filled[rows, columns] = spsolve(matrix.tocsc(), right).reshape(count, -1)
    return filled
