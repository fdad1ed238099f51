"""Whether training keeps the tracks it starts from: no release without it.

`python bench/tracks.py [--preset NAME] [--seeds N]`

Two phantoms of 32 frames at 320x256, one of them pulled by 30 mm, sliding, and with patches of hardly any texture.
Compared are the carried points of the scene before the first iteration, those of the trained scene, and chained optical
flow, on textured tissue. Exit status 1 if training makes the mean error of the tracks larger by more than `ALLOWED_PX`,
or more than `WORSE_SHARE` of the tracks are worse than the flow by more than a pixel.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import common  # noqa: F401, before torch
import numpy as np
from numpy.typing import NDArray

from endoprior.data import FrameSequence, load_sequence
from endoprior.evaluation.scorers.tracks import PredictedTracks, TrueTracks, by_chained_flow, by_scene, true_tracks
from endoprior.model.presets import preset
from endoprior.phantom import PhantomConfig, write_phantom
from endoprior.training.gaussian_trainer import GaussianTrainer

ALLOWED_PX = 0.05
WORSE_SHARE = 0.02
SIZE = {"frames": 32, "width": 320, "height": 256}
PHANTOMS = {
    "plain": PhantomConfig(**SIZE),
    "pulled": PhantomConfig(**SIZE, pull_mm=30.0, slide_mm=12.0, smooth_share=0.3),
}


def track_errors(predicted: PredictedTracks, true: TrueTracks) -> NDArray[np.float64]:
    """(P,) mean distance in the image over the frames that show the point, px; textured tissue only."""
    counted = true.visible & true.counted
    distance = np.where(
        counted, np.linalg.norm(predicted.pixels - np.where(counted[..., None], true.pixels, 0), axis=-1), 0
    )
    textured = np.ones(len(true.first), bool) if true.region is None else true.region != "smooth"
    return (distance.sum(0) / counted.sum(0))[textured & counted.any(0)]


def compare(name: str, sequence: FrameSequence, preset_name: str, seed: int) -> list[str]:
    """Print the errors of one training; what is wrong with them."""
    true = true_tracks(sequence)
    trainer = GaussianTrainer(sequence, preset(preset_name, seed=seed))
    trainer.start()
    start = track_errors(by_scene(trainer.scene(), true, sequence), true)
    trainer.run([])
    trained = track_errors(by_scene(trainer.scene(), true, sequence), true)
    flow = track_errors(by_chained_flow(true, sequence), true)
    worse = float((trained > flow + 1).mean())
    parts = ", ".join(
        f"{what} {errors.mean():.2f} (median {np.median(errors):.2f})"
        for what, errors in (("flow", flow), ("start", start), ("trained", trained))
    )
    print(
        f"{name}, seed {seed}, mean error of {len(flow)} tracks, px: {parts}; worse than flow {worse:.1%}", flush=True
    )
    wrong = []
    if trained.mean() > start.mean() + ALLOWED_PX:
        wrong.append(f"{name}, seed {seed}: training makes tracks worse by {trained.mean() - start.mean():.2f} px")
    if worse > WORSE_SHARE:
        wrong.append(
            f"{name}, seed {seed}: {worse:.1%} of the tracks are worse than the flow, at most {WORSE_SHARE:.0%} may be"
        )
    return wrong


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--preset", default="default")
    parser.add_argument("--seeds", type=int, default=1)
    options = parser.parse_args()
    wrong: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        for name, config in PHANTOMS.items():
            write_phantom(Path(folder) / name, config)
            for seed in range(options.seeds):
                wrong += compare(name, load_sequence(Path(folder) / name), options.preset, seed)
    sys.exit("\n".join(wrong) or 0)  # any string, even an empty one, would be a failure


if __name__ == "__main__":
    main()
