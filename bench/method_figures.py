"""Make the figures of docs/method.md, results.md and tutorial.md again: `python bench/method_figures.py WORK`.

Trains `default` on a phantom of 24 frames (320x256) and renders everything from that. WORK keeps sequence and run; what
is there is not made again.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import cv2
import figures
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

import endoprior
from endoprior.core.geometry import project
from endoprior.data import FrameSequence
from endoprior.model.scene import Scene
from endoprior.priors import joint_texture_prior, salience, specular_likelihood
from endoprior.training.temporal import MOTION_TEMPERATURE, MOTION_THRESHOLD, motion_weight
from endoprior.view.viewable import ViewSettings
from endoprior.view.viewable_scene import ViewableScene
from endoprior.visualization.rendered_views import turned

PHANTOM = ("--frames", 24, "--width", 320, "--height", 256)
FRAME = 12
TURNS_DEGREES = (0, 10, 20, 35)
WIDTH_INCHES = 9.0
CHECK_WIDTH_PX = 900


def figure(columns: int, height: float, ratios: list[float] | None = None) -> tuple[Figure, list]:
    result = Figure(figsize=(WIDTH_INCHES, height), layout="constrained", dpi=110)
    FigureCanvasAgg(result)
    return result, list(np.atleast_1d(result.subplots(1, columns, width_ratios=ratios)))


def show(axis: object, image: NDArray, title: str, **options: object) -> object:
    axis.set_title(title, fontsize=9)
    axis.set_axis_off()
    return axis.imshow(image, **options)


def save(result: Figure, name: str) -> None:
    """Write docs/images/method/`name`.jpg."""
    path = figures.IMAGES / "method" / f"{name}.jpg"
    result.savefig(path, pil_kwargs={"quality": 85})
    print(path, f"{path.stat().st_size / 1024:.0f} kB")


def check(data: Path, picture: Path) -> None:
    figures.endoprior("check", data, "--out", picture)
    image = cv2.imread(str(picture))
    factor = CHECK_WIDTH_PX / image.shape[1]
    figures.save("method/check.jpg", cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA))


def prior(sequence: FrameSequence) -> None:
    """A frame, the two cues, and the prior that they make."""
    frame = sequence.frame(FRAME)
    result, axes = figure(4, 2.1)
    show(axes[0], frame.rgb_u8, "frame")
    show(axes[1], specular_likelihood(frame.rgb), r"highlights $L^{sp}$", vmin=0, vmax=1)
    show(axes[2], salience(frame.rgb, frame.tissue_mask), r"edges and texture $E$", vmin=0, vmax=1)
    rho = joint_texture_prior(frame.rgb, frame.tissue_mask)
    image = show(axes[3], rho, r"prior $\rho = M (1 - L^{sp}) E$", vmin=0, vmax=1)
    result.colorbar(image, ax=axes, shrink=0.8)
    save(result, "prior")


def gaussians(scene: Scene, sequence: FrameSequence) -> None:
    """What is rendered, the Gaussians by their score, and how far they have moved."""
    viewable, camera = ViewableScene(scene, "", sequence), scene.cameras[FRAME]
    result, axes = figure(3, 2.7)
    settings = ViewSettings(frame=FRAME)
    show(axes[0], viewable.picture(settings, camera), "rendered")
    dots = replace(settings, layer="prior", points=True)
    show(axes[1], viewable.picture(dots, camera), "Gaussians: score $s$, blue 0 to red 1")
    moved = replace(settings, layer="displacement")
    show(axes[2], viewable.picture(moved, camera), viewable.legend(moved))
    save(result, "gaussians")


def temporal(scene: Scene) -> None:
    """The motion weight over the score, and where the Gaussians with a high weight are."""
    score = scene.prior_score.numpy()
    weights = motion_weight(score, MOTION_THRESHOLD, MOTION_TEMPERATURE)
    result, axes = figure(2, 2.9, [1, 1.35])
    line = np.linspace(0, 1, 200)
    axes[0].plot(line, motion_weight(line, MOTION_THRESHOLD, MOTION_TEMPERATURE), color="tab:red")
    axes[0].hist(score, 50, range=(0, 1), weights=np.full(len(score), 5 / len(score)), color="tab:gray", alpha=0.5)
    axes[0].set_ylim(0, 1.05)
    axes[0].set_xlabel("texture-prior score $s$ (gray: its histogram)")
    axes[0].set_ylabel(r"motion weight $w^{mot}$")
    at = FRAME / len(scene.cameras)
    pixels, _ = project(scene.at(at).means.numpy(), scene.cameras[FRAME])
    show(axes[1], scene.render(at).color.numpy() * 0.5, "Gaussians of one frame by motion weight")
    order = np.argsort(weights)
    dots = axes[1].scatter(*pixels[order].T, c=weights[order], s=0.6, vmin=0, vmax=1)
    axes[1].set_xlim(0, scene.cameras[0].width)
    axes[1].set_ylim(scene.cameras[0].height, 0)
    result.colorbar(dots, ax=axes[1])
    save(result, "temporal")


def sides(scene: Scene) -> None:
    """The same time step from the endoscope and from more and more to the side."""
    at, camera = FRAME / len(scene.cameras), scene.cameras[FRAME]
    distance = float(np.median(scene.render(at).depth.numpy()))
    result, axes = figure(len(TURNS_DEGREES), 2.1)
    for axis, degrees in zip(axes, TURNS_DEGREES, strict=True):
        image = scene.render(at, turned(camera, -degrees, distance)).color.numpy()
        show(axis, image, f"turned by {degrees} degrees" if degrees else "endoscope's view")
    save(result, "sides")


def main() -> None:
    work = Path(sys.argv[1] if len(sys.argv) > 1 else "figures")
    work.mkdir(parents=True, exist_ok=True)
    (figures.IMAGES / "method").mkdir(exist_ok=True)
    data, run = work / "small_phantom", work / "small_run"
    if not data.exists():
        figures.endoprior("phantom", data, *PHANTOM)
    if not (run / "metrics.json").exists():
        figures.endoprior("train", data, run, "--no-networks")
    scene, sequence = endoprior.load_scene(run), endoprior.load_sequence(data)
    check(data, work / "check.png")
    prior(sequence)
    gaussians(scene, sequence)
    temporal(scene)
    sides(scene)


if __name__ == "__main__":
    main()
