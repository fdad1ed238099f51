"""What fp16 planes change in the images of a trained HexPlane scene: tissue PSNR of its test frames, dB.

`python bench/fp16_planes.py RUN DATA`; on the CPU, with the PyTorch implementations that a GPU runs.
"""

from __future__ import annotations

import sys
from pathlib import Path
from unittest import mock

import common
import numpy as np

from endoprior.data import FrameSequence, load_sequence
from endoprior.evaluation.scorers.image import psnr_tissue
from endoprior.evaluation.scoring import scored_data
from endoprior.model.ops import TORCH
from endoprior.model.scene import Scene
from endoprior.model.scene_file import load_scene


def scores(scene: Scene, sequence: FrameSequence) -> np.ndarray:
    found = []
    for frame in sequence.frames("test"):
        color = scene.render(frame.time, frame.camera).color.numpy()
        found.append(psnr_tissue(color, frame.rgb, frame.tissue_mask))
    return np.array(found)


def main() -> None:
    run, data = map(Path, sys.argv[1:])
    scene = load_scene(run)
    sequence = load_sequence(data, scored_data(scene.config.data))
    with mock.patch("endoprior.model.scene.ops_for", lambda device: TORCH):
        full, fp16 = scores(scene, sequence), scores(scene.to("cpu", fp16_planes=True), sequence)
    told = f"{len(full)} frames: {full.mean():.4f} dB, fp16 planes {fp16.mean():.4f}"
    print(f"{common.source_commit()}, {told}; largest change {abs(fp16 - full).max():.4f}")


if __name__ == "__main__":
    main()
