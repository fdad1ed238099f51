"""Write a scene in one of the formats, whole or not at all."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core.checks import input_error
from ..system.atomic import whole_file, whole_folder, write_json
from .formats import Format, Progress, all_suffixes, load_format
from .options import DEFAULTS, ExportOptions

if TYPE_CHECKING:
    from ..model.scene import Scene


def export(
    scene: Scene, out: Path, options: ExportOptions, progress: Progress = lambda done, total: None
) -> list[Path]:
    """Write `scene` in the format that `options` names.

    Args:
        out: a file if its suffix is the format's, else a new or empty folder.
    Returns:
        What was written: one file, or one folder.
    Raises:
        InputError: an option has no meaning for the format, `out` does not suit it, or there is nothing to write.
    """
    chosen = load_format(options.format)
    _reject_unused_options(options, chosen)
    options = replace(options, frame=options.frame or chosen.default_axes)
    if chosen.write:
        _check_file(out, chosen.suffixes, options.format)
        chosen.write(scene, out, options, progress)
    else:
        _export_time_steps(scene, out, options, chosen, progress)
    return [out]


def _reject_unused_options(options: ExportOptions, chosen: Format) -> None:
    for field in fields(options):
        given = getattr(options, field.name) != getattr(DEFAULTS, field.name)
        if given and field.name not in ("format", *chosen.options):
            known = ", ".join(f"--{name.replace('_', '-')}" for name in chosen.options) or "no options"
            want, fix = f"an option of --format {options.format}", f"leave it out. The format takes {known}."
            raise input_error(f"--{field.name.replace('_', '-')}", want, "one that it does not use", fix)


def _export_time_steps(scene: Scene, out: Path, options: ExportOptions, chosen: Format, progress: Progress) -> None:
    from .time_steps import selected_time_steps

    steps = selected_time_steps(scene, options)
    if out.suffix in all_suffixes():
        _check_file(out, chosen.suffixes, options.format)
        if len(steps) != 1:
            fix = "pass --times T, or a folder instead of a file."
            raise input_error(out, "one time step for one file", f"{len(steps)}", fix)
        contents = chosen.files(scene, steps[0], options)
        _check_file(out, tuple(contents), options.format)
        with whole_file(out) as temporary:
            temporary.write_bytes(contents[out.suffix])
        progress(1, 1)
        return
    with whole_folder(out) as folder:
        written = []
        for k, step in enumerate(steps):
            contents = chosen.files(scene, step, options)
            for suffix, content in contents.items():
                (folder / f"{step.name}{suffix}").write_bytes(content)
            written.append({"files": [f"{step.name}{suffix}" for suffix in contents], **step.facts()})
            progress(k + 1, len(steps))
        units: Mapping[str, Any] = chosen.index_facts or {"axes": options.frame, "unit": "mm"}
        facts = {"lengths_are_relative": scene.lengths_are_relative, "frames_per_second": scene.frames_per_second}
        write_json(folder / "index.json", {"format": options.format, **units, **facts, "time_steps": written})


def _check_file(out: Path, suffixes: tuple[str, ...], name: str) -> None:
    if suffixes and out.suffix not in suffixes:
        want = f"a file name that ends in {' or '.join(suffixes)} for --format {name}"
        raise input_error(out, want, out.suffix or "no suffix", "choose another name.")
    if suffixes and out.is_dir():
        raise input_error(out, "the name of a file", "a folder", "choose another name.")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise input_error(out, "a place where a file can be written", f"{error.strerror}", "choose another.") from error
