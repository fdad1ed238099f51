"""Open formats for other programs: each module of this package knows one, this file knows them all.

A format is either a set of files per moment (`files(scene, moment, options)` in its module) or one output for the
whole sequence (`write(scene, out, options, progress)`). docs/format.md says what files hold, docs/export.md how to ask.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.checks import InputError
from ..system.atomic import whole_file, whole_folder, write_json
from .options import DEFAULTS, Axes, ExportOptions

if TYPE_CHECKING:
    from ..model.scene import Scene

Progress = Callable[[int, int], None]
"""Takes how much is done and how much there is."""

_USUAL = ("times", "split", "frame")


@dataclass(frozen=True)
class Format:
    """What must be known of a format before its module is imported."""

    module: str
    suffixes: tuple[str, ...]
    """Of its files: all of them per moment, or the one that OUT must end in; empty where OUT is a folder."""
    options: tuple[str, ...]
    """Fields of `ExportOptions` that mean something to it."""
    axes: Axes = "opencv"
    """What --frame stands for where it is not given."""
    per_moment: bool = True


FORMATS = {
    "ply": Format("ply", (".ply",), (*_USUAL, "canonical")),
    "splat": Format("splat", (".splat",), (*_USUAL, "canonical")),
    "spz": Format("spz", (".spz",), (*_USUAL, "canonical"), "opengl"),
    "gltf": Format("gltf", (".glb",), (*_USUAL, "canonical"), "opengl"),
    "points": Format("points", (".ply",), (*_USUAL, "canonical", "min_opacity")),
    "mesh": Format(
        "mesh",
        (".ply", ".obj", ".stl"),
        (*_USUAL, "mesh_format", "mesh_method", "mesh_step", "max_slope", "voxel_mm", "min_alpha"),
    ),
    "depth": Format("depth", (".png", ".npy"), ("times", "split", "min_alpha")),
    "tracks": Format("tracks", (), ("frame", "points", "grid_px", "min_alpha"), per_moment=False),
    "video": Format("video", (".mp4",), ("split",), per_moment=False),
    "scene": Format("scene_file", (".safetensors",), (), per_moment=False),
    "html": Format("page", (".html",), ("times", "title", "max_mb"), per_moment=False),
}
"""Every format by the name that --format takes."""


def export(
    scene: Scene, out: Path, options: ExportOptions, progress: Progress = lambda done, total: None
) -> list[Path]:
    """Write `scene` in the format that `options` names, whole or not at all.

    Args:
        out: a file if its suffix is the format's, else a new or empty folder.
    Returns:
        What was written: one file, or one folder.
    Raises:
        InputError: an option has no meaning for the format, `out` does not suit it, or there is nothing to write.
    """
    form = FORMATS[options.format]
    _refuse_meaningless(options, form)
    options = replace(options, frame=options.frame or form.axes)
    if form.per_moment:
        _export_moments(scene, out, options, form, progress)
    else:
        _check_file(out, form.suffixes, options.format)
        import_module(f".{form.module}", __package__).write(scene, out, options, progress)
    return [out]


def _refuse_meaningless(options: ExportOptions, form: Format) -> None:
    for field in fields(options):
        given = getattr(options, field.name) != getattr(DEFAULTS, field.name)
        if given and field.name not in ("format", *form.options):
            raise InputError(
                f"--{field.name.replace('_', '-')}: expected an option of --format {options.format}; got one it has no "
                f"use for. Leave it out; it takes {', '.join(form.options) or 'none'}."
            )


def _export_moments(scene: Scene, out: Path, options: ExportOptions, form: Format, progress: Progress) -> None:
    from .moments import chosen_moments

    moments = chosen_moments(scene, options)
    files = import_module(f".{form.module}", __package__).files
    suffixes = tuple(s for s in form.suffixes if options.format != "mesh" or s == f".{options.mesh_format}")
    known = {suffix for each in FORMATS.values() for suffix in each.suffixes}
    if out.suffix in known:
        _check_file(out, suffixes, options.format)
        if len(moments) != 1:
            raise InputError(
                f"{out}: expected one moment for one file; got {len(moments)}. "
                "Pass --times T, or a folder instead of a file."
            )
        with whole_file(out) as temporary:
            temporary.write_bytes(files(scene, moments[0], options)[out.suffix])
        progress(1, 1)
        return
    with whole_folder(out) as folder:
        written = []
        for k, moment in enumerate(moments):
            contents = files(scene, moment, options)
            for suffix, content in contents.items():
                (folder / f"{moment.name}{suffix}").write_bytes(content)
            written.append({"files": [f"{moment.name}{suffix}" for suffix in contents], **moment.facts()})
            progress(k + 1, len(moments))
        write_json(folder / "index.json", _index(scene, written, options))


def _index(scene: Scene, written: list[dict], options: ExportOptions) -> dict:
    about = {"format": options.format, "axes": options.frame, "unit": "mm"}
    if options.format == "depth":
        about = {"format": "depth", "png_unit_mm": 0.01, "npy_unit_mm": 1.0, "missing": 0}
    about |= {"lengths_are_relative": scene.lengths_are_relative}
    return about | {"frames_per_second": scene.frames_per_second, "moments": written}


def _check_file(out: Path, suffixes: tuple[str, ...], name: str) -> None:
    if suffixes and out.suffix not in suffixes:
        raise InputError(
            f"{out}: expected a file name that ends in {' or '.join(suffixes)} for --format {name}; "
            f"got {out.suffix or 'no suffix'}. Choose another name."
        )
    if suffixes and out.is_dir():
        raise InputError(f"{out}: expected the name of a file; got a folder. Choose another name.")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{out}: expected a place where a file can be written; got {error.strerror}. Choose another."
        ) from error
