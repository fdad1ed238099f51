"""The options of `endoprior export`, with their ranges."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ..core.checks import check_range
from .formats import REGISTRY, Axes


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """Options of an export. Each format takes some of them and rejects the others."""

    format: Literal[REGISTRY.names()] | None = None
    """Format; by default the one of OUT's suffix: .ply and .glb are Gaussians, .obj is a mesh.
    Blender opens `animation` (a moving mesh, .glb) and `mesh`. A folder has no default."""
    times: tuple[float, ...] = ()
    """Times in [0, 1] to export instead of frames. Frame i of T is at i / T."""
    split: Literal["video", "test", "train"] = "video"
    """Frames to export; `video` is all of them."""
    canonical: bool = False
    """Export the Gaussians as they are stored, before any motion."""
    frame: Axes | None = None
    """Axes of the coordinates. opencv: x right, y down, z forward; opengl: y up, z back; ras, lps: for 3D Slicer.
    Default: opengl for spz, gltf and animation, whose specifications require it; else opencv."""
    min_alpha: float = 0.5
    """Accumulated opacity from which a pixel shows a surface (depth, meshes, tracks)."""
    min_opacity: float = 0.5
    """Least opacity of a Gaussian that becomes a point (points)."""
    mesh_format: Literal["ply", "obj", "stl"] | None = None
    """Files of a mesh; by default OUT's suffix. In a folder ply; STL has no colors."""
    mesh_method: Literal["grid", "tsdf"] = "grid"
    """`grid`: a grid mesh of the depth that the frame's camera sees; `tsdf`: the depths of all cameras fused."""
    mesh_step: int = 2
    """Pixels between the vertices of a grid mesh."""
    max_slope: float = 5.0
    """Depth change per mm sideways above which a grid mesh is cut."""
    voxel_mm: float = 1.0
    """Edge of a voxel of the fusion, mm."""
    points: Path | None = None
    """CSV with columns x, y, frame: pixels to track; default: a grid on the first frame (tracks).
    For measures the rows are the corners of a polygon, and the first two the ends of a distance; default: none.
    For slicer they become a list of points; default: none."""
    grid_px: int = 32
    """Pixels between the points of that grid."""
    data: Path | None = None
    """Sequence folder whose masks tell where tools hide a point (tracks). Default: the one of the run."""
    from_frame: int = 0
    """Frame that displacement and stretch refer to (measures)."""
    to_frame: int | None = None
    """Frame whose displacement and stretch the surface shows; default: the last (measures)."""
    title: str = ""
    """Title above the player (html)."""
    max_mb: float = 20.0
    """Largest player to write, MB (html)."""

    def __post_init__(self) -> None:
        for time in self.times:
            check_range("times", time, 0, 1)
        check_range("min_alpha", self.min_alpha, 0.01, 1)
        check_range("min_opacity", self.min_opacity, 0, 1)
        check_range("mesh_step", self.mesh_step, 1, 1000)
        check_range("max_slope", self.max_slope, 0.01, 1000)
        check_range("voxel_mm", self.voxel_mm, 0.01, 1000)
        check_range("grid_px", self.grid_px, 1, 100_000)
        check_range("max_mb", self.max_mb, 0.1, 1000)


DEFAULTS = ExportOptions()
"""What every option is where it is not given."""
