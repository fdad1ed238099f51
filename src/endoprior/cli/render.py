"""`endoprior render RUN [OUT]`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from ..core.checks import input_error
from ..system.console import say
from .arguments import Help, parse
from .devices import Wanted, on_device
from .paths import folder_of, open_scene, reject_without_gaussians

if TYPE_CHECKING:
    from ..model.scene import RenderedScene


@dataclass
class Render:
    """Render a trained scene: rgb/*.png, depth/*.npy (mm), side_by_side/*.png and an mp4.

    With `--layer texture` it writes texture/*.png and texture.mp4: a grid painted on the first frame, carried by the
    model's motion, beside the input. Where the grid slides on the tissue, the motion is wrong (docs/results.md).

    With `--layer support` it writes support/*.png and support.mp4: tissue that no frame saw is hatched, tissue from
    another time is blue; support/*.npy says how many frames saw it and how many seconds away the nearest is.
    """

    run: Path = field(metadata={"place": "RUN"})
    """Run folder."""
    out: Path | None = field(default=None, metadata={"place": "OUT"})
    """Output folder. Default: RUN/renders for the frames and RUN/video.mp4 for the video."""
    split: Literal["video", "test", "train"] = "video"
    """Frames of the sequence to render."""
    layer: Literal["color", "texture", "support"] = "color"
    """Color and depth; a grid on the tissue that shows how the model moves; or what was seen and what is guessed."""
    times: tuple[float, ...] = ()
    """Times in [0, 1] to render instead of a split."""
    camera: Literal["sequence", "sway"] = "sequence"
    """The sequence's own camera, or one that sways around it."""
    camera_path: Path | None = None
    """JSON list of {"time", "world_to_camera"} to render instead of a split; it has times and cameras of its own."""
    highlights: bool = True
    """`--no-highlights` shows the tissue below them, as other frames show it. Default: RUN/renders/no_highlights."""
    data: Path | None = None
    """Sequence folder with the input frames. Default: the one the run was trained on."""
    device: Wanted = "auto"
    """Where to compute. `auto` uses CUDA only if all of it works (`endoprior doctor`)."""


HELP = Help(
    examples=(
        ("RUN",),
        ("RUN", "OUT", "--split", "test"),
        ("RUN", "OUT", "--camera", "sway"),
        ("RUN", "OUT", "--layer", "texture"),
        ("RUN", "OUT", "--layer", "support"),
        ("RUN", "OUT", "--no-highlights"),
    ),
)


def run(argv: list[str]) -> None:
    """Load the scene and render it."""
    args = parse(Render, argv, "render", HELP)
    reject_two_choices(args)
    scene = open_scene(args.run)
    render(scene, args)


def reject_two_choices(args: Render) -> None:
    """One option alone says which times are rendered, and one from where.

    Raises:
        InputError: a second one was given; it would have no effect.
    """
    times, split, camera = args.times != (), args.split != Render.split, args.camera != Render.camera
    path = args.camera_path is not None
    pairs = {("--camera-path", "--times"): path and times, ("--camera-path", "--split"): path and split,
             ("--camera-path", "--camera"): path and camera, ("--times", "--split"): times and split}  # fmt: skip
    for (first, second), both in pairs.items():
        if both:
            raise input_error(second, f"one of {first} and {second}", "both", f"Remove {first} or {second}.")


def render(scene: RenderedScene, args: Render) -> None:
    """Render the views selected by `args` and print the output paths."""
    from .paths import require_writable_folder

    run = folder_of(args.run)
    require_writable_folder("OUT" if args.out else "RUN", args.out or run)
    if args.layer != "color" or not args.highlights:
        reject_without_gaussians(scene, args.run)
    scene = on_device(scene, args.device, fp16_planes=True)
    from ..data import load_sequence
    from ..evaluation.scoring import scored_data
    from ..model.highlights import without_highlights
    from ..runs.folder import sequence_of_run
    from ..system.atomic import removed_on_failure
    from ..visualization.camera_paths import read_path, sway_path, times_path
    from ..visualization.rendered_views import depth_span, write_views
    from ..visualization.tissue_layers import SupportMap, write_support_film, write_texture_film

    frames, sequence, total = None, None, len(scene.cameras)
    if bad := [t for t in args.times if not 0 <= t <= 1]:
        raise input_error("--times", "times in [0, 1]", str(bad[0]), "Correct it; frame i of T is at i / T.")
    if args.layer == "support" or not args.highlights or not (args.camera_path or args.times):
        sequence = load_sequence(args.data or sequence_of_run(run), scored_data(scene.config.data))
        if len(sequence) != total:
            fix = "`--data FOLDER` with the sequence of the run."
            raise input_error(sequence.path, f"{total} frames", str(len(sequence)), fix)
    if not args.highlights:
        scene = without_highlights(scene, sequence.training_part)
    if args.camera_path:
        views = read_path(args.camera_path, scene.cameras)
    else:
        times = list(args.times)
        if not times:
            frames = sequence.frames(args.split)
            times = [index / total for index in sequence.indices(args.split)]
        if args.camera == "sway":
            frames = None
            views = sway_path(times, scene.cameras, sum(depth_span(scene)) / 2)
        else:
            views = times_path(times, scene.cameras)
    beside = not args.highlights and not args.out  # what is there with highlights is kept
    out = args.out or run / "renders"
    video = (args.out or run) / ("video.mp4" if args.layer == "color" else f"{args.layer}.mp4")
    if not args.out and out.is_symlink():  # in an untrusted run the link could point anywhere
        raise input_error(out, "a folder", "a link to one", "Remove the link, or pass OUT.")
    if beside:
        out, video = out / "no_highlights", video.with_stem(f"{video.stem}_no_highlights")
    with removed_on_failure(args.out or out):
        if args.layer == "color":
            write_views(scene, views, out, video, frames)
        elif args.layer == "texture":
            out /= "texture"
            write_texture_film(scene, views, out, video, frames)
        else:
            out /= "support"
            support = SupportMap(scene, sequence.training_part)
            write_support_film(support, views, out, video, scene.frames_per_second, frames)
    images = out / "rgb" if args.layer == "color" else out
    if (others := len(list(images.glob("*.png"))) - len(views)) > 0:
        say(f"note: other images were in {images} before: {others}")
    say(f"{len(views)} frames: {out}\nvideo: {video}")
