"""Every export format, and the options of `endoprior export`. To add a format, see docs/export.md.

docs/format.md says what the files of each format hold.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ..core.checks import check_range
from ..system.plugins import Registry

if TYPE_CHECKING:
    from ..core.types import Splats
    from ..model.scene import Scene

Axes = Literal["opencv", "opengl", "ras", "lps"]
"""Axes that exported coordinates refer to; docs/format.md defines them."""
Progress = Callable[[int, int], None]
"""Takes how much is done and how much there is."""
Files = Callable[["Scene", Any, "ExportOptions"], dict[str, bytes]]

FORMATS = {
    "ply": "ply:PLY",
    "compressed_ply": "packed_splats:COMPRESSED_PLY",
    "sog": "packed_splats:SOG",
    "splat": "packed_splats:SPLAT",
    "spz": "packed_splats:SPZ",
    "gltf": "gltf:GAUSSIANS",
    "points": "ply:POINTS",
    "mesh": "mesh:FORMAT",
    "animation": "gltf:ANIMATION",
    "usd": "usd:FORMAT",
    "slicer": "slicer:FORMAT",
    "cameras": "frames:CAMERAS",
    "tum": "frames:TUM",
    "kitti": "frames:KITTI",
    "depth": "frames:DEPTH",
    "tracks": "tracks:FORMAT",
    "measures": "measures:FORMAT",
    "video": "frames:VIDEO",
    "scene": "frames:SCENE",
    "html": "html:FORMAT",
}
"""Module of this package and object in it by the name that --format takes, in the order of the command's help."""
TIME_STEP_OPTIONS = ("times", "split", "frame")
"""Options of most formats that have a file for each time step."""


@dataclass(frozen=True)
class ExportFormat:
    """One export format: what it writes, and which options it takes. Either `files` or `write` is set."""

    suffixes: tuple[str, ...]
    """Suffixes of its files; empty for a `write` that makes a folder."""
    options: tuple[str, ...]
    """Fields of `ExportOptions` that the format uses; others are rejected."""
    files: Files | None = None
    """The contents of the files of one `time_steps.TimeStep`, by suffix."""
    write: Callable[[Scene, Path, ExportOptions, Progress], None] | None = None
    """Writes one output for the whole sequence."""
    suffix_option: str = ""
    """Field of `ExportOptions` that chooses between the suffixes, as `mesh_format`; by default the file's name does."""
    default_axes: Axes = "opencv"
    """What --frame stands for where it is not given."""
    holds: str = ""
    """What is in a file, in plain words: `a mesh`; `endoprior export` says it of what it wrote."""
    has_index: bool = True
    """Whether a folder of its files also holds `index.json`; False where each file says itself what it is."""
    read: Callable[[bytes], Splats] | None = None
    """The Gaussians in a file of one time step, in the axes of the file: `endoprior export` says what was lost."""
    note: Callable[[Scene, Path, ExportOptions], str] | None = None
    """What a user of the file must know, in one line; `endoprior export` says it."""
    index_facts: Mapping[str, Any] | None = None
    """What `index.json` says of the files' units, for a format without axes in mm."""


def _problem(found: Any) -> str:
    if not isinstance(found, ExportFormat):
        return f"an object of type {type(found).__name__}"
    has_one = (found.files is None) != (found.write is None)
    return "" if has_one else "an ExportFormat with both or none of files and write"


def _built_in(name: str) -> ExportFormat:
    module, _, variable = FORMATS[name].partition(":")
    return getattr(import_module(f".{module}", __package__), variable)


REGISTRY: Registry[ExportFormat] = Registry(
    "exporters", "an ExportFormat of endoprior.export.formats", _problem, modules=tuple(FORMATS), load_module=_built_in
)
"""The formats above, and those of plugins."""
RANGES = {
    "min_alpha": (0.01, 1),
    "min_opacity": (0, 1),
    "mesh_step": (1, 1000),
    "max_slope": (0.01, 1000),
    "voxel_mm": (0.01, 1000),
    "grid_px": (1, 100_000),
    "max_mb": (0.1, 1000),
}
"""The least and the largest value of options."""


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """Options of an export. Each format takes some of them and rejects the others."""

    format: Literal[REGISTRY.names()] | None = None  # pyright: ignore[reportInvalidTypeForm]
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
        for name, (low, high) in RANGES.items():
            check_range(name, getattr(self, name), low, high)

    @property
    def axes(self) -> Axes:
        """`frame`; `export` has put the format's default in the place of None."""
        return self.frame or "opencv"


def load_format(name: str) -> ExportFormat:
    """The format of that name; imports its module.

    Raises:
        InputError: it is a plugin that cannot be used.
        ValueError: there is none.
    """
    if name not in REGISTRY.names():
        raise ValueError(f"format must be one of {', '.join(REGISTRY.names())}; got {name!r}")
    return REGISTRY.load(name)


def usable_formats() -> dict[str, ExportFormat]:
    """Every format that can be used, by name, plugins last."""
    return {name: REGISTRY.load(name) for name in FORMATS} | dict(REGISTRY.usable())


def formats_of(suffix: str) -> list[str]:
    """Names of the formats that write files of this suffix: the one that it stands for first, plugins last."""
    return [name for name, each in usable_formats().items() if suffix in each.suffixes]
