"""`endoprior render RUN [OUT]`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from ..core.checks import InputError
from ..doctor.choice import Wanted
from .devices import on_device
from .parsing import parse
from .progress import say

if TYPE_CHECKING:
    from ..model.scene import Scene


@dataclass
class Render:
    """Draw a trained scene: rgb/*.png, depth/*.npy (mm), side_by_side/*.png and an mp4."""

    run: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="RUN")]]
    """Run folder."""
    out: tyro.conf.Positional[Annotated[Path | None, tyro.conf.arg(metavar="OUT")]] = None
    """Folder for the frames; RUN/renders if not given, and then the film is RUN/video.mp4."""
    split: Literal["video", "test", "train"] = "video"
    """Frames of the sequence to draw."""
    times: tuple[float, ...] = ()
    """Moments in [0, 1] to draw in place of a split."""
    camera: Literal["sequence", "sway"] = "sequence"
    """The sequence's own camera, or one that sways around it."""
    camera_path: Path | None = None
    """JSON list of {"time", "world_to_camera"} to follow in place of a split."""
    data: Path | None = None
    """Sequence folder for the originals; the one the run was trained on if not given."""
    device: Wanted = "auto"
    """Where to draw; auto takes CUDA only where all of it works (`endoprior doctor`)."""


def run(argv: list[str]) -> None:
    """Draw."""
    args = parse(Render, argv, "render")
    from ..model.scene import load_scene

    scene = load_scene(args.run)
    draw(scene, args)


def draw(scene: Scene, args: Render) -> None:
    """Draw what `args` asks for and say where it is."""
    from .places import demand_folder_place

    demand_folder_place("OUT" if args.out else "RUN", args.out or args.run)
    scene = on_device(scene, args.device, fp16_planes=True)
    from ..data import load_sequence
    from ..evaluation.scoring import scored_data
    from ..show.camera_paths import read_path, sway_path, times_path
    from ..show.frames import depth_span, write_views
    from .evaluate import sequence_of_run

    frames, total = None, len(scene.cameras)
    if bad := [t for t in args.times if not 0 <= t <= 1]:
        raise InputError(f"--times: expected moments in [0, 1]; got {bad[0]}. Frame i of T is at i / T.")
    if args.camera_path:
        views = read_path(args.camera_path, scene.cameras)
    else:
        times = list(args.times)
        if not times:
            sequence = load_sequence(args.data or sequence_of_run(args.run), scored_data(scene.config.data))
            if len(sequence) != total:
                raise InputError(
                    f"{sequence.path}: expected {total} frames; got {len(sequence)}. Pass the run's sequence."
                )
            frames = sequence.frames(args.split)
            times = [index / total for index in sequence.indices(args.split)]
        if args.camera == "sway":
            frames = None
            views = sway_path(times, scene.cameras, sum(depth_span(scene)) / 2)
        else:
            views = times_path(times, scene.cameras)
    out = args.out or args.run / "renders"
    video = args.out / "video.mp4" if args.out else args.run / "video.mp4"
    if not args.out and out.is_symlink():  # a run from a stranger could point it anywhere
        raise InputError(f"{out}: expected a folder; got a link to one. Remove it, or name OUT.")
    write_views(scene, views, out, video, frames)
    say(f"{len(views)} views: {out}\n{video}")
