"""Whether the tissue is stretched as the scene says; needs a phantom whose tissue moves by a law (`--mechanics`).

Errors are over the true tracks that the first frame shows, in which the tissue is undeformed, at the later frames that
show them. Chained optical flow and no motion stand beside the scene. `T` frames, `P` points.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...core.geometry import Strain, camera_to_world, cells_at, project
from ...data import FrameSequence
from ...footage.image_operations import distance_inside
from ...model.carry import carry_points
from ...model.measures import SurfaceMotion, strain_around, surface_samples
from ...model.scene import Scene
from ..context import EvaluationContext
from ..score import Score
from .tracks import REFERENCES, chained_flow

PARTS = {"near": (0, 5), "middle": (5, 15), "far": (15, math.inf)}
"""Distance of a point from tools and from borders of the image, mm on the tissue, by the name of the part."""
MIN_RATIO = 1.1
"""The direction of the largest stretch is compared where the two true stretches differ by this factor or more."""
HIDDEN = "hidden"  # The part of points that a frame does not show
OVER_ALL = (
    Score(
        "deformation_displacement_mm", "displacement error", "mm", False, 3,
        "Mean error of the displacement since the first frame; phantoms with --mechanics only.",
        group="motion", hint="0 moves as the tissue",
    ),
    Score(
        "deformation_stretch", "stretch error", "", False, 3,
        "Mean error of the largest principal stretch since the first frame; phantoms with --mechanics only.",
        compare="absolute", group="motion", hint="0 stretches as the tissue",
    ),
    Score(
        "deformation_area", "area error", "", False, 3,
        "Mean error of the area after over before; phantoms with --mechanics only.",
        compare="absolute", group="motion", hint="0 grows as the tissue",
    ),
    Score(
        "deformation_direction_deg", "stretch direction", "deg", False, 1,
        "Mean angle between the directions of the largest stretch, where the true ones differ by 10 % or more.",
        group="motion", hint="45: by chance",
    ),
)  # fmt: skip
TEXTS = {
    "near": ("near", "less than 5 mm from tools and borders of the image"),
    "middle": ("middle", "5 to 15 mm from tools and borders of the image"),
    "far": ("far", "more than 15 mm from tools and borders of the image"),
    HIDDEN: ("hidden", "in frames that do not show them"),
}
OF_PARTS = tuple(
    score.variant(part, short, f"points {where}", in_summary=score.name == "deformation_stretch" and part != HIDDEN)
    for score in OVER_ALL
    for part, (short, where) in TEXTS.items()
)
ERRORS = OVER_ALL + OF_PARTS
OF_REFERENCES = tuple(score.variant(end, short, what) for score in ERRORS for end, (short, what) in REFERENCES.items())
SCORES = ERRORS + OF_REFERENCES
NO_POINT = "no such point has a value"


@dataclass(frozen=True)
class Deformed:
    """What the truth or a method says of points since the first frame, in the axes of its camera."""

    displacement: NDArray[np.floating]  # (T, P, 3) mm
    strain: Strain  # (T, P)


def compute(context: EvaluationContext) -> None:
    """Compare the deformation of the scene and of the references with the true one; nothing without that."""
    sequence = context.sequence
    truth = sequence.truth and sequence.truth.deformation
    tracks = sequence.truth and sequence.truth.tracks
    if not truth or not tracks:
        return
    chosen = tracks.visible[0]
    true = Deformed(truth.displacement[:, chosen], Strain(*(values[:, chosen] for values in truth.strain)))
    points, visible = tracks.points[:, chosen].astype(np.float64), tracks.visible[:, chosen]
    parts = parts_of(points, visible, sequence)
    methods: dict[str, Callable[[], Deformed]] = {
        "": lambda: by_scene(context.scene, points[0], sequence),
        "_dis": lambda: by_chained_flow(points[0], sequence),
        "_still": lambda: without_motion(true),
    }
    for end, method in methods.items():
        with context.skip_if_unavailable(*(score.name + end for score in ERRORS)):
            for name, value in deformation_errors(method(), true, parts).items():
                context.add(name + end, value, NO_POINT)


def deformation_errors(found: Deformed, true: Deformed, parts: dict[str, NDArray[np.bool_]]) -> dict[str, float]:
    """Every score of `ERRORS` by name; NaN where no point of a part has a value. `parts`: (T, P) by name; "" is all."""
    cosine = np.abs((found.strain.direction * true.strain.direction).sum(-1)).clip(0, 1)
    is_directed = true.strain.stretch[..., 0] >= MIN_RATIO * true.strain.stretch[..., 1]
    errors = {
        "deformation_displacement_mm": np.linalg.norm(found.displacement - true.displacement, axis=-1),
        "deformation_stretch": np.abs(found.strain.stretch - true.strain.stretch)[..., 0],
        "deformation_area": np.abs(found.strain.area - true.strain.area),
        "deformation_direction_deg": np.where(is_directed, np.rad2deg(np.arccos(cosine)), np.nan),
    }
    means = {}
    for name, error in errors.items():
        for part, where in parts.items():
            values = error[where & np.isfinite(error)]
            means[f"{name}_{part}".removesuffix("_")] = float(values.mean()) if len(values) else math.nan
    return means


def parts_of(points: NDArray, visible: NDArray[np.bool_], sequence: FrameSequence) -> dict[str, NDArray[np.bool_]]:
    """(T, P) which points (T, P, 3), in camera axes of each frame, count in each part; the first frame in none."""
    far = np.full(visible.shape, np.nan)
    for i, frame in enumerate(sequence.frames("video")):
        camera, shown = replace(frame.camera, world_to_camera=np.eye(4)), visible[i]
        pixels, z = project(points[i, shown], camera)
        columns, rows = cells_at(pixels, camera.width, camera.height)
        inside = distance_inside(np.pad(frame.tissue_mask, 1))[1:-1, 1:-1]
        far[i, shown] = inside[rows, columns] * z / camera.fx
    later = np.arange(len(visible))[:, None] > 0
    near = {part: visible & later & (far >= low) & (far < high) for part, (low, high) in PARTS.items()}
    return {"": visible & later, **near, HIDDEN: ~visible & later}


def by_scene(scene: Scene, starts: NDArray, sequence: FrameSequence) -> Deformed:
    """Points (P, 3), in camera axes of the first frame, carried by the Gaussians; strain as `export` measures it."""
    frames = list(range(len(sequence)))
    pose = camera_to_world([sequence.camera(0)])[0]
    world = starts @ pose[:3, :3].T + pose[:3, 3]
    moved = carry_points(scene, world, np.zeros(len(world), np.intp), [i / len(frames) for i in frames])
    strain = SurfaceMotion(scene, 0).strain(world, frames)
    return Deformed((moved - world) @ pose[:3, :3], Strain(strain.stretch, strain.direction @ pose[:3, :3]))


def by_chained_flow(starts: NDArray, sequence: FrameSequence) -> Deformed:
    """The same points moved by optical flow and measured depth; strain from the same grid of measured depth."""
    first = sequence.frame(0)
    at_origin = replace(first.camera, world_to_camera=np.eye(4))
    samples = surface_samples(np.where(first.depth_valid & first.tissue_mask, first.depth, 0), at_origin)
    to_first = first.camera.world_to_camera @ camera_to_world(sequence.camera(i) for i in range(len(sequence)))

    def carried(points: NDArray) -> NDArray:
        moved = chained_flow(points, np.zeros(len(points), np.intp), sequence).points
        return np.einsum("tij,tpj->tpi", to_first[:, :3, :3], moved) + to_first[:, None, :3, 3]

    return Deformed(carried(starts) - starts, strain_around(starts, samples, len(sequence), carried))


def without_motion(true: Deformed) -> Deformed:
    """Points that stay; they have no direction of stretch."""
    strain = Strain(np.ones_like(true.strain.stretch), np.full_like(true.strain.direction, np.nan))
    return Deformed(np.zeros_like(true.displacement), strain)
