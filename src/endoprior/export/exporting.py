"""Write a scene in one of the formats, whole or not at all, and compare what was written with the scene."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from .. import render
from ..core.checks import input_error
from ..core.geometry import length_unit
from ..core.ranges import evenly_spaced
from ..core.types import Splats
from ..model.scene import RenderedScene, Scene, with_gaussians
from ..system.atomic import whole_file, whole_folder, write_json
from .axes import ROTATIONS, rotated
from .formats import REGISTRY, ExportFormat, ExportOptions, Files, Progress, formats_of, load_format, usable_formats
from .time_steps import TimeStep, selected_time_steps


def format_name(out: Path, options: ExportOptions) -> str:
    """The format that `options` name, else the first one of `out`'s suffix; InputError if neither names one."""
    if name := options.format or next(iter(formats_of(out.suffix)), None):
        return name
    got = f"the suffix {out.suffix}" if out.suffix else "a name without a suffix"
    known = dict.fromkeys(suffix for each in usable_formats().values() for suffix in each.suffixes)
    fix = f"Choose a suffix of {' '.join(known)}, or add --format with one of {', '.join(REGISTRY.names())}."
    raise input_error(out, "a file whose suffix says the format, or --format", got, fix)


def export(
    scene: RenderedScene,
    out: str | Path,
    options: ExportOptions | None = None,
    progress: Progress = lambda *_: None,
) -> list[Path]:
    """Write `scene`, of any device, in the format that `options` names, whole or not at all.

    Args:
        scene: from `train` or `load_scene`.
        out: a file if its suffix is the format's, else a new or empty folder.
        options: None: all as they are, and the format by the suffix of `out`.
    Returns:
        What was written: one file, or one folder.
    Raises:
        InputError: no format is named, neither by the options nor by `out`; an option has no meaning for the format;
            `out` does not suit it; there is nothing to write; or the scene is a radiance field.

    Example:
        >>> import endoprior
        >>> from endoprior.export import ExportOptions
        >>> files = endoprior.export(endoprior.load_scene("RUN"), "tissue.ply", ExportOptions(times=(0.5,)))
        >>> [file.name for file in files]
        ['tissue.ply']
    """
    scene = with_gaussians(scene.to("cpu"))  # where formats read its numbers
    out, options = Path(out), options or ExportOptions()
    name = format_name(out, options)
    chosen = load_format(name)
    for field in fields(options):
        given = getattr(options, field.name) != field.default
        if given and field.name not in ("format", *chosen.options):
            known = ", ".join(map(_option, chosen.options)) or "no options"
            want, fix = f"an option of --format {name}", f"Leave it out. The format takes {known}."
            raise input_error(_option(field.name), want, "one that it does not use", fix)
    options = replace(options, format=name, frame=options.frame or chosen.default_axes)
    if chosen.suffix_option:
        options = replace(options, **{chosen.suffix_option: _by_suffix(out, options, chosen)})
    if chosen.files is not None:
        _write_time_steps(scene, out, options, chosen, chosen.files, progress)
    elif chosen.write is not None:
        _check_file(out, chosen.suffixes, name)
        chosen.write(scene, out, options, progress)
    return [out]


def _option(field: str) -> str:
    return f"--{field.replace('_', '-')}"


def _by_suffix(out: Path, options: ExportOptions, chosen: ExportFormat) -> str:
    """The value of the option that chooses between the format's suffixes: as given, else as the file is named."""
    given, option = getattr(options, chosen.suffix_option), _option(chosen.suffix_option)
    named = out.suffix.removeprefix(".") if out.suffix in chosen.suffixes else None
    if given and named and given != named:
        raise input_error(f"{option} {given}", f"a file that ends in .{given}", str(out), f"Remove {option}.")
    return given or named or chosen.suffixes[0].removeprefix(".")


def _write_time_steps(
    scene: Scene, out: Path, options: ExportOptions, chosen: ExportFormat, files: Files, progress: Progress
) -> None:
    steps, name = selected_time_steps(scene, options), str(options.format)
    if same_suffix := formats_of(out.suffix):
        _check_file(out, chosen.suffixes, name)
        if len(steps) != 1:
            moving = [other for other in same_suffix if load_format(other).write]
            instead = "".join(f", or --format {other} for all of them" for other in moving)
            times = "--times T with T in [0, 1] (in Python ExportOptions(times=(T,)))"
            fix = f"Pass {times}, or a folder instead of a file{instead}."
            raise input_error(out, "one time step for one file", f"{len(steps)}", fix)
        contents = files(scene, steps[0], options)
        _check_file(out, tuple(contents), name)
        with whole_file(out) as temporary:
            temporary.write_bytes(contents[out.suffix])
        progress(1, 1)
        return
    with whole_folder(out) as folder:
        written = []
        for k, step in enumerate(steps):
            contents = {f"{step.name}{suffix}": each for suffix, each in files(scene, step, options).items()}
            for file, content in contents.items():
                (folder / file).write_bytes(content)
            written.append({"files": list(contents), **step.facts()})
            progress(k + 1, len(steps))
        if chosen.has_index:
            relative = scene.lengths_are_relative
            units = chosen.index_facts or {"axes": options.axes, "unit": length_unit(relative)}
            facts = {"lengths_are_relative": relative, "frames_per_second": scene.frames_per_second}
            write_json(folder / "index.json", {"format": name, **units, **facts, "time_steps": written})


def _check_file(out: Path, suffixes: tuple[str, ...], name: str) -> None:
    if suffixes and out.suffix not in suffixes:
        want = f"a file name that ends in {' or '.join(suffixes)} for --format {name}"
        raise input_error(out, want, out.suffix or "no suffix", "Choose another name.")
    if suffixes and out.is_dir():
        raise input_error(out, "the name of a file", "a folder", "Choose another name.")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        want = "a place where a file can be written"
        raise input_error(out, want, f"{error.strerror}", "Choose another place.") from error


MAX_FRAMES = 3
INVISIBLE_DB = 60.0
"""At this PSNR the error is a quarter of a step of 8 bits."""


def loss_note(scene: Scene, out: Path, options: ExportOptions, chosen: ExportFormat) -> str:
    """PSNR of a few of the files just written against the scene, in one line; empty for a format that is not read.

    Both are rendered as the endoscope sees them, without smoke.
    """
    if chosen.read is None:
        return ""
    steps = selected_time_steps(scene, options)
    some = [steps[k] for k in evenly_spaced(len(steps), MAX_FRAMES)]
    back = ROTATIONS[options.frame or chosen.default_axes].T
    errors = []
    for step in some:
        file = out / f"{step.name}{chosen.suffixes[0]}" if out.is_dir() else out
        found = _rendered(scene, step, rotated(chosen.read(file.read_bytes()), back))
        errors.append(float(((found - _as_trained(scene, step)) ** 2).mean()))
    psnr = float(-10 * np.log10(max(np.mean(errors), 1e-12)))
    count = "the image" if len(some) == 1 else f"{len(some)} images"
    result = f"{psnr:.1f} dB" if psnr < INVISIBLE_DB else f"over {INVISIBLE_DB:.0f} dB, no visible difference"
    why = "; one color for each Gaussian (docs/export.md)" if scene.config.render.color_slopes else ""
    return f"the file shows {count} of the scene with a PSNR of {result}{why}."


def _as_trained(scene: Scene, step: TimeStep) -> Tensor:
    if step.canonical:
        return _rendered(scene, step, step.splats(scene, "opencv"))
    return scene.render(step.time, step.camera(scene)).color.cpu()


@torch.no_grad()
def _rendered(scene: Scene, step: TimeStep, splats: Splats) -> Tensor:
    background = torch.tensor(scene.background, dtype=splats.means.dtype)
    return render.load("numba")(splats, step.camera(scene), background=background).color.clamp(0, 1)
