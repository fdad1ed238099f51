"""The path by COLMAP (`pycolmap`, optional): SIFT, sequential matching and incremental mapping on the CPU.

Its images are masked by tools, highlights and what our own tracks found to deform. Its scale, like that of poses from a
file, is set by our depth; frames that it does not register are placed by our own tracks.
"""

from __future__ import annotations

import copy
import tempfile
import time as clock
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...data.description import COLMAP_POSES
from ...data.images import save_png
from .adjust import adjust, back_projected
from .features import usable_tissue
from .follow import Follower
from .own import finished_path, place_frames
from .path import CameraPath
from .tracks import FrameReader, PoseInput, TrackingCamera, Tracks

ENOUGH_IMAGES, MAX_STRIDE = 150, 4  # a longer clip is mapped by every second to fourth frame
LONGEST = 1000  # longer clips are mapped only if COLMAP is asked for: it takes seconds a frame
DEFORMING = 0.1  # tracks below this weight deform; the tissue around them is masked ...
AROUND = 40  # ... within the image width divided by this
SECONDS_AN_IMAGE = 1.0  # about the time on two cores. Mapping that alone takes longer is stopped: see `time_note`.
MIN_SECONDS = 60  # mapping may always take this long
MIN_REGISTERED_SHARE = 0.3  # a model with a smaller share of the frames is no path of the clip
PARALLAX = 0.02  # least spread of the rays to a point, rad, whose position counts for the scale
MIN_POINTS = 10  # with fewer such points in a frame, its scale is that of the frames around
STRIDE = 3  # points are placed by every third frame and all keyframes: neighbors add nothing


def time_note(seconds: float, limit: float) -> list[str]:
    """A note for the user if mapping was stopped, because the path then depends on the speed of the machine."""
    if seconds < limit:
        return []
    return [f"COLMAP was stopped after {limit:.0f} s: a faster machine may find another path; `--poses own` does not"]


def is_installed() -> bool:
    """Whether `pycolmap` can be imported."""
    return find_spec("pycolmap") is not None


def colmap_path(frames: FrameReader, follower: Follower) -> CameraPath | None:
    """The path by COLMAP, in the unit of our depth; None if no model holds enough frames.

    Args:
        follower: our own tracks, their points adjusted: they show what deforms, and fill in frames. The path's focal
            factor is relative to their camera.
    """
    import pycolmap

    count = frames.count
    stride = min(-(-count // ENOUGH_IMAGES), MAX_STRIDE)
    pycolmap.logging.minloglevel = 2
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for part in ("images", "masks", "models"):
            (folder / part).mkdir()
        for i in range(0, count, stride):
            seen = frames.frame(i)
            save_png(folder / f"images/{i:06d}.png", seen.rgb_u8)
            save_png(folder / f"masks/{i:06d}.png.png", _allowed(seen, follower, i).astype(np.uint8) * 255)
        models, notes = _reconstruct(pycolmap, folder, follower.camera)
    best = max(models.values(), key=lambda model: model.num_reg_images(), default=None)
    if best is None or best.num_reg_images() < max(MIN_REGISTERED_SHARE * len(range(0, count, stride)), 3):
        return None
    poses, known = np.tile(np.eye(4), (count, 1, 1)), np.zeros(count, bool)
    for image in best.images.values():
        if image.has_pose:
            index = int(Path(image.name).stem)
            poses[index, :3], known[index] = image.cam_from_world().matrix(), True
    factor = float(next(iter(best.cameras.values())).params[0] / follower.camera.matrix[0, 0])
    unit = float(np.exp(np.median(np.log(with_poses(follower, poses, known, factor).scales[known]))))
    poses[:, :3, 3] /= unit
    world = with_poses(follower, poses, known, factor)
    if not world.camera.depth_is_relative:
        world.scales[:] = 1.0
    explained = known | (follower.segment == follower.segment[np.argmax(known)])
    stds = place_frames(world, np.flatnonzero(known), follower.poses, explained)
    explained = known | (explained & np.isfinite(stds[0]))
    path = finished_path(world, explained, *stds)
    return replace(path, method=COLMAP_POSES, focal_factor=factor, notes=notes)


def _reconstruct(pycolmap: Any, folder: Path, camera: TrackingCamera) -> tuple[dict[int, Any], list[str]]:
    """All models of the images in a folder, and notes; COLMAP counts the center of the left-most pixel as 0.5."""
    matrix = camera.matrix
    database = folder / "database.db"
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model, reader.mask_path = "PINHOLE", folder / "masks"
    reader.camera_params = ",".join(map(str, (matrix[0, 0], matrix[1, 1], matrix[0, 2] + 0.5, matrix[1, 2] + 0.5)))
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.sift.max_num_features = 2000
    extraction.sift.peak_threshold = 0.003
    mapping = pycolmap.IncrementalPipelineOptions()
    mapping.ba_refine_focal_length = mapping.mapper.abs_pose_refine_focal_length = camera.focal_is_assumed
    mapping.random_seed = 0
    mapping.extract_colors = False
    mapping.mapper.init_min_tri_angle = 4.0
    mapping.max_num_models = 2
    limit = int(max(MIN_SECONDS, SECONDS_AN_IMAGE * len(list((folder / "images").iterdir()))))
    mapping.max_runtime_seconds = limit
    device, single = pycolmap.Device.cpu, pycolmap.CameraMode.SINGLE
    options = {"reader_options": reader, "extraction_options": extraction, "device": device}
    pycolmap.set_random_seed(0)
    pycolmap.extract_features(database, folder / "images", camera_mode=single, **options)
    pycolmap.match_sequential(database, device=device)
    began = clock.perf_counter()
    models = pycolmap.incremental_mapping(database, folder / "images", folder / "models", mapping)
    return models, time_note(clock.perf_counter() - began, limit)


def _allowed(seen: PoseInput, follower: Follower, index: int) -> NDArray[np.bool_]:
    """(H, W) tissue without highlights, and without what deforms."""
    tracks, mask = follower.tracks, usable_tissue(seen).astype(np.uint8)
    ids = tracks.ids[index]
    for x, y in tracks.pixels[index][tracks.adjusted[ids] & (tracks.weight[ids] < DEFORMING)]:
        cv2.circle(mask, (round(float(x)), round(float(y))), mask.shape[1] // AROUND, 0, -1)
    return mask.astype(bool)


def with_poses(follower: Follower, poses: NDArray, known: NDArray[np.bool_], focal_factor: float = 1.0) -> Follower:
    """A copy of the tracks whose points lie where poses (T, 4, 4) see them, with the depth scale of each frame.

    Args:
        known: (T,) frames that have a pose.
    """
    out = copy.copy(follower)
    tracks = out.tracks = follower.tracks.copy()
    tracks.camera = out.camera = follower.camera.with_focal(focal_factor)
    out.poses, out.scales = poses.copy(), np.ones(len(poses))
    position, spread = ray_points(tracks, poses, known)
    good = spread > PARALLAX
    scales = np.full(len(poses), np.nan)
    for f in np.flatnonzero(known):
        ids, depths = tracks.ids[f], tracks.depths[f]
        z = position[ids] @ poses[f][2, :3] + poses[f][2, 3]
        use = good[ids] & (depths > 0) & (z > 0)
        if use.sum() >= MIN_POINTS:
            scales[f] = np.median(z[use] / depths[use])
    there = np.flatnonzero(np.isfinite(scales))
    if len(there):
        out.scales = np.exp(np.interp(np.arange(len(poses)), there, np.log(scales[there])))
    keys = {k.frame for k in follower.keyframes}
    frames = [int(f) for n, f in enumerate(np.flatnonzero(known)) if n % STRIDE == 0 or f in keys]
    for f in reversed(frames):  # the first sight of a point stays
        ids, pixels, z = tracks.ids[f], tracks.pixels[f].astype(np.float64), tracks.depths[f] * out.scales[f]
        tracks.points[ids] = back_projected(out.camera.matrix, poses[f], pixels, z)
    tracks.points[good] = position[good]
    ids, seen = tracks.of_frames(frames, out.scales)
    if len(ids):
        fixed = np.ones(len(frames), bool)
        done = adjust(out.camera.matrix, poses[frames], tracks.points[ids], seen, fixed, rounds=4, steps=2)
        tracks.points[ids], tracks.weight[ids], tracks.adjusted[ids] = done.points, done.track_weight, True
    return out


def ray_points(tracks: Tracks, poses: NDArray, known: NDArray[np.bool_]) -> tuple[NDArray, NDArray]:
    """(P, 3) point nearest to all rays of each track, and (P,) the spread of the rays, rad; 0 with less than two rays.

    The point minimizes sum |(I - d d^T) (X - c)|^2 over rays with center c and direction d.
    """
    matrix, right, number = np.zeros((tracks.count, 9)), np.zeros((tracks.count, 3)), np.zeros(tracks.count)
    inverse = np.linalg.inv(tracks.camera.matrix)
    for f in np.flatnonzero(known):
        ids = tracks.ids[f]
        rays = np.concatenate([tracks.pixels[f], np.ones((len(ids), 1))], 1) @ inverse.T @ poses[f][:3, :3]
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        across = np.eye(3) - rays[:, :, None] * rays[:, None]
        center = -poses[f][:3, :3].T @ poses[f][:3, 3]
        np.add.at(matrix, ids, across.reshape(-1, 9))
        np.add.at(right, ids, across @ center)
        np.add.at(number, ids, 1)
    matrix = matrix.reshape(-1, 3, 3)
    several = number > 1
    points, spread = np.zeros((tracks.count, 3)), np.zeros(tracks.count)
    values = np.linalg.eigvalsh(matrix[several]) if several.any() else np.zeros((0, 3))
    spread[several] = np.sqrt(np.maximum(values[:, 0], 0) / number[several])
    solvable = spread > 1e-6
    points[solvable] = np.linalg.solve(matrix[solvable], right[solvable][:, :, None])[:, :, 0]
    return points, spread
