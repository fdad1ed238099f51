"""`endoprior render RUN [OUT]`."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from ..core.checks import input_error
from ..system.console import say
from .arguments import Command
from .devices import Wanted, on_device
from .paths import folder_of, open_scene, require_writable_folder, sequence_of

if TYPE_CHECKING:
    from ..model.scene import RenderedScene


@dataclass
class Render(Command):
    """Render a trained scene: rgb/*.png, depth/*.npy (mm), side_by_side/*.png and an mp4.

    With `--layer texture` it writes texture/*.png and texture.mp4: a grid painted on the first frame, carried by the
    model's motion, beside the input. Where the grid slides on the tissue, the motion is wrong (docs/results.md).

    With `--layer support` it writes support/*.png and support.mp4: tissue that no frame saw is hatched, guessed depth
    is dotted, tissue from another time blue; support/*.npy has the number of frames, and seconds to the nearest.
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
    """Highlights; without them the tissue below, as other frames show it. Default OUT: RUN/renders/no_highlights."""
    smoke: bool = True
    """The smoke that training found. Default OUT: RUN/renders/no_smoke."""
    data: Path | None = None
    """Sequence folder with the input frames. Default: the one the run was trained on."""
    device: Wanted = "auto"
    """Where to compute. `auto` uses CUDA only if all of it works (`endoprior doctor`)."""

    examples = (
        "RUN",
        "RUN OUT --split test",
        "RUN OUT --camera sway",
        "RUN OUT --layer texture",
        "RUN OUT --layer support",
        "RUN OUT --no-highlights",
    )

    def execute(self) -> None:
        """Load the scene and render it."""
        self._reject_two_choices()
        self.render(open_scene(self.run))

    def _reject_two_choices(self) -> None:
        """One option alone says which times are rendered, and one from where: a second one would have no effect."""
        names = ("times", "split", "camera") if self.camera_path else ("split",) if self.times else ()
        first = "--camera-path" if self.camera_path else "--times"
        for name in names:
            if getattr(self, name) != getattr(Render, name):
                second = f"--{name}"
                raise input_error(second, f"one of {first} and {second}", "both", f"Remove {first} or {second}.")
        if bad := [t for t in self.times if not 0 <= t <= 1]:
            raise input_error("--times", "times in [0, 1]", str(bad[0]), "Correct it; frame i of T is at i / T.")

    def render(self, scene: RenderedScene) -> None:
        """Render the scene of `run` and print the output paths."""
        from ..model.highlights import without_highlights
        from ..model.scene import with_gaussians
        from ..system.atomic import removed_on_failure
        from ..visualization.rendered_views import depth_span, read_path, sway_path, times_path, write_views
        from ..visualization.tissue_layers import SupportMap, write_support_video, write_texture_video

        run, frames = folder_of(self.run), None
        require_writable_folder("OUT" if self.out else "RUN", self.out or run)
        if self.layer != "color" or not self.highlights:
            with_gaussians(scene, self.run)
        out, video = self._places(run)
        scene = on_device(scene, self.device, fp16_planes=True)
        sequence = cache(partial(sequence_of, scene, run, self.data))  # which times alone do not need
        if not self.highlights:
            scene = without_highlights(with_gaussians(scene, self.run), sequence().training_part)
        times = list(self.times)
        if not times and not self.camera_path:
            frames, total = sequence().frames(self.split), len(scene.cameras)
            times = [index / total for index in sequence().indices(self.split)]
        if self.camera_path:
            views = read_path(self.camera_path, scene.cameras)
        elif self.camera == "sway":
            frames, views = None, sway_path(times, scene.cameras, sum(depth_span(scene)) / 2)
        else:
            views = times_path(times, scene.cameras)
        images = out / {"color": "rgb"}.get(self.layer, self.layer)
        with removed_on_failure(self.out or out):
            if self.layer == "color":
                write_views(scene, views, out, video, frames, smoke=self.smoke)
            elif self.layer == "texture":
                write_texture_video(with_gaussians(scene, self.run), views, images, video, frames)
            else:
                support = SupportMap(with_gaussians(scene, self.run), sequence().training_part)
                write_support_video(support, views, images, video, scene.frames_per_second, frames)
        if (others := len(list(images.glob("*.png"))) - len(views)) > 0:
            say(f"note: other images were in {images} before: {others}")
        say(f"{len(views)} frames: {out if self.layer == 'color' else images}\nvideo: {video}")

    def _places(self, run: Path) -> tuple[Path, Path]:
        """The folder for images and the file of the video; what is there with highlights and smoke is kept."""
        out = self.out or run / "renders"
        video = (self.out or run) / ("video.mp4" if self.layer == "color" else f"{self.layer}.mp4")
        if not self.out and out.is_symlink():  # in an untrusted run the link could point anywhere
            raise input_error(out, "a folder", "a link to one", "Remove the link, or pass OUT.")
        left_out = [f"no_{name}" for name in ("highlights", "smoke") if not getattr(self, name)]
        if not left_out or self.out:
            return out, video
        return out / "_".join(left_out), video.with_stem("_".join([video.stem, *left_out]))
