"""Make the picture of docs/bad_result.md again: `python bench/symptom_figures.py WORK`.

Trains `preview` on a phantom of 16 frames three times: as it should be, with a tool that no mask covers, and for too
few iterations. WORK keeps sequences and runs; what is there is not made again.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import figures
import numpy as np
from method_figures import figure, show

import endoprior
from endoprior.data.images import save_png
from endoprior.view.viewable import ViewSettings
from endoprior.view.viewable_scene import ViewableScene
from endoprior.visualization.rendered_views import turned

PHANTOM = ("--frames", 16, "--width", 160, "--height", 128, "--no-side-views")
FRAME = 9
"""A held-out frame."""
FEW_ITERATIONS = 20
ASIDE_DEGREES = 35


def without_masks(data: Path, copy: Path) -> None:
    """The sequence with empty masks: every tool counts as tissue."""
    shutil.copytree(data, copy)
    for mask in (copy / "masks").iterdir():
        save_png(mask, np.zeros((PHANTOM[5], PHANTOM[3]), np.uint8))


def train(data: Path, run: Path, *options: object) -> endoprior.Scene:
    if not (run / "metrics.json").exists():
        figures.endoprior("train", data, run, "--preset", "preview", "--no-networks", *options)
    return endoprior.load_scene(run)


def main() -> None:
    work = Path(sys.argv[1] if len(sys.argv) > 1 else "figures")
    work.mkdir(parents=True, exist_ok=True)
    data, unmasked = work / "symptom_phantom", work / "symptom_unmasked"
    if not data.exists():
        figures.endoprior("phantom", data, *PHANTOM)
    if not unmasked.exists():
        without_masks(data, unmasked)
    good = train(data, work / "symptom_good")
    tool = train(unmasked, work / "symptom_tool", "--trust-masks")
    few = train(data, work / "symptom_few", "--iterations", FEW_ITERATIONS)
    at, camera = FRAME / len(good.cameras), good.cameras[FRAME]
    distance = float(np.median(good.render(at).depth.numpy()))
    support = ViewableScene(good, "", endoprior.load_sequence(data))
    aside = turned(camera, -ASIDE_DEGREES, distance)
    result, axes = figure(5, 1.9)
    show(axes[0], good.render(at).color.numpy().clip(0, 1), "as it should be")
    show(axes[1], tool.render(at).color.numpy().clip(0, 1), "tool left in")
    show(axes[2], few.render(at).color.numpy().clip(0, 1), "too few iterations")
    show(axes[3], support.picture(ViewSettings(frame=FRAME, layer="support"), camera), "seen or guessed")
    show(axes[4], good.render(at, aside).color.numpy().clip(0, 1), "from the side")
    path = figures.IMAGES / "symptoms.jpg"
    result.savefig(path, pil_kwargs={"quality": 85})
    print(path, f"{path.stat().st_size / 1024:.0f} kB")


if __name__ == "__main__":
    main()
