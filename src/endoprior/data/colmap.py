"""Reader of folders with `images/` and COLMAP's sparse model: poses are world to camera, in OpenCV axes."""

from __future__ import annotations

from pathlib import Path

from ..core.checks import input_error
from ..core.config import DataConfig
from .colmap_model import read_colmap
from .files import IMAGE_SUFFIXES, entries, in_order
from .formats import Format
from .posed_images import PosedImage, load_posed
from .sequence import FrameSequence

PLACES = ("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse")
"""Where programs put the model."""


def is_colmap(path: Path) -> bool:
    """Whether a folder has images and a model, and no poses of its own."""
    return (path / "images").is_dir() and not (path / "poses_bounds.npy").exists() and model_folder(path) is not None


def load_colmap(path: Path, cfg: DataConfig) -> FrameSequence:
    """Open the registered images, in the order of their names.

    Raises:
        InputError: the model or an image cannot be used.
    """
    model = model_folder(path)
    if model is None:
        fix = "pass the folder that holds images/ and sparse/0/."
        raise input_error(path / PLACES[0], "cameras and images, .bin or .txt", "no such files", fix)
    registered, files = read_colmap(model)
    remarks: list[str] = []
    siblings = entries(model.parent) if model.name.isdigit() else []
    if others := sorted(each.name for each in siblings if each != model and each.name.isdigit()):
        remarks.append(f"{model}: other parts of the model, {', '.join(others)}, are not used")
    posed = [PosedImage(path / "images" / each.name, each.lens, each.world_to_camera) for each in registered]
    posed = present(model, posed, remarks)
    own = [file for file in entries(path / "images") if file.suffix.lower() in IMAGE_SUFFIXES]
    if missing := len({file.name for file in own} - {each.file.name for each in posed}):
        remarks.append(f"{model}: {missing} of {len(own)} images have no pose and are left out")
    rank = {file: i for i, file in enumerate(in_order(each.file for each in posed))}
    posed.sort(key=lambda each: rank[each.file])
    return load_posed(path, cfg, model, posed, files, remarks)


def present(source: Path, posed: list[PosedImage], remarks: list[str]) -> list[PosedImage]:
    """The images whose files are there; a remark counts the others.

    Raises:
        InputError: none is there.
    """
    there = [each for each in posed if each.file.is_file()]
    if not there:
        got = f"none of {len(posed)}, such as {posed[0].file}" if posed else "none"
        raise input_error(source, "images that are there", got, "put the images where the file says.")
    if len(there) < len(posed):
        remarks.append(f"{source}: {len(posed) - len(there)} of {len(posed)} images are not there and are left out")
    return there


def model_folder(path: Path) -> Path | None:
    """The folder of the model in a project folder; None if there is none."""
    for place in PLACES:
        for suffix in (".bin", ".txt"):
            if all((path / place / f"{name}{suffix}").is_file() for name in ("cameras", "images")):
                return path / place
    return None


FORMAT = Format(is_colmap, load_colmap)
