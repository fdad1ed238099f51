"""Score a scene, or rendered images, against the sequence, under a protocol that is stored with the numbers.

A score that cannot be computed is listed as skipped, with the reason. No other number ever stands in for it.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..compute.parallel_kernels import start_threads
from ..core.checks import input_error
from ..core.config import DataConfig
from ..core.types import Fingerprints
from ..data import FrameSequence, Split, check_sequence
from ..model.scene import RenderedScene
from ..system.devices import name_of
from .context import Evaluation, EvaluationContext, Reconstruction, SceneFrames
from .protocols.compute import score_protocols, tags_of
from .protocols.table import OURS
from .registry import REGISTRY, SCORERS, scorers
from .score import ScoreUnavailable
from .scorers.model import FPS_RENDERS, LONGEST_SECONDS

SAME_FILES = "these files"
SAME_IMAGES = "these images; masks, depth, poses or descriptions were others"
OTHER_IMAGES = "other images"
"""What a scene was trained on, compared with what it is scored on: `trained_on` of the protocol."""
SHOWN_DIGITS = 8  # of a fingerprint, in a warning

log = logging.getLogger(__name__)


def evaluate(
    scene: RenderedScene | Reconstruction,
    sequence: FrameSequence,
    split: Split = "test",
    *,
    networks: bool = True,
    speed: bool = True,
    download: bool = False,
    weights_dir: Path | None = None,
    reading: DataConfig | None = None,
    given_path: NDArray[np.float64] | None = None,
    protocols: Sequence[str] = (),
) -> Evaluation:
    """Score `scene` on a split of `sequence`: every score that docs/scores.md lists.

    Args:
        scene: a trained scene, or anything that renders the frames of the sequence (`Reconstruction`). Scores that
            need a scene, or its Gaussians, are skipped where there are none.
        networks: also compute the scores that need a network (RAFT, LPIPS). Their weights are looked for in
            `weights_dir`, then in `ENDOPRIOR_WEIGHTS`, then in torch's cache.
        download: get weights that are in none of these from `download.pytorch.org`. False: scores that need
            them are skipped.
        speed: also measure how many frames are rendered a second.
        reading: how `sequence` was read, for the protocol; None: as the scene's config says, or the default. One that
            was opened without a `DataConfig` is read so, with depth as it was measured.
        given_path: (T, 4, 4) camera-to-world, mm, with which the scene's cameras are compared where the sequence has no
            true path.
        protocols: also score as these papers did, into `Evaluation.protocols`.
    Raises:
        InputError: the sequence is not the one the scene was trained on: the number of frames differs, or their size,
            except by `shrink`. Other images of this number and size are scored all the same, with a warning; other
            masks, depth or poses without one. `trained_on` in `Evaluation.protocol` says which it was.
        RuntimeError: this process is a fork of one that has rendered or trained.

    Example:
        >>> import endoprior
        >>> scene, sequence = endoprior.load_scene("RUN"), endoprior.load_sequence("DATA")
        >>> result = endoprior.evaluate(scene, sequence, networks=False)
        >>> result.protocol["frames"], 0 < result.scores["psnr"] < 99
        ([1, 9], True)
    """
    start_threads()
    check_sequence(sequence)
    if isinstance(scene, (str, Path)):
        name = repr(str(scene))
        raise input_error("scene", "a trained scene", name, f"`endoprior.load_scene({name})`.")
    if isinstance(scene, RenderedScene):
        if reading is None:
            sequence = sequence.read_as(scored_data(scene.config.data))
        _reject_other_frames(scene, sequence)
        sequence = sequence.with_poses(scene.cameras)  # in which it was trained; they may have been estimated again
        frames, reading = SceneFrames(scene, sequence), reading or scene.config.data
    else:
        frames = scene
    reading, fingerprints = reading or DataConfig(), sequence.fingerprints()
    result = Evaluation(_protocol(sequence, split, reading) | {"data_fingerprint": fingerprints.data})
    if isinstance(scene, RenderedScene):
        result.protocol |= _facts_of(scene, sequence, split, fingerprints)
    result.provenance = dict(getattr(scene, "provenance", {}))
    result.per_frame = [{"index": i, "time": i / len(sequence)} for i in sequence.indices(split)]
    context = EvaluationContext(
        frames, sequence, split, networks, weights_dir, result, given_path, speed, download=networks and download
    )
    for name, scorer in scorers().items():
        with context.skip_if_unavailable(*(score.name for score in scorer.SCORES)):
            try:
                scorer.compute(context)
            except Exception as error:  # in a plugin it costs the plugin's scores only
                if name in SCORERS or isinstance(error, ScoreUnavailable):
                    raise
                raise ScoreUnavailable(REGISTRY.failure(name, error)) from error
    result.rendered = context.rendered
    result.protocol["tags"] = tags_of(OURS, context, sequence.indices(split), sequence.mask_folder, reading.shrink)
    result.protocols = score_protocols(protocols, context, scored_data(reading))
    return result


def _reject_other_frames(scene: RenderedScene, sequence: FrameSequence) -> None:
    """Raise InputError where the scene has another number of frames, or its cameras another size than the images, which
    may be the same ones shrunk otherwise.
    """
    if len(sequence) != len(scene.cameras):
        expected = f"the {len(scene.cameras)} frames the scene was trained on"
        raise input_error(sequence.path, expected, str(len(sequence)), "pass the same sequence.")
    ours, theirs = scene.cameras[0], sequence.camera(0)
    if (ours.width, ours.height) == (theirs.width, theirs.height):
        return
    shrink = scene.config.data.shrink
    other = shrink if sequence.reading is None else sequence.reading.shrink
    # Blocks of n x n px: an image of w px was n w to n w + n - 1 px wide.
    pairs = ((ours.width, theirs.width), (ours.height, theirs.height))
    if not all(max(shrink * a, other * b) < min(shrink * (a + 1), other * (b + 1)) for a, b in pairs):
        expected = f"images of {ours.width}x{ours.height} px, on which the scene was trained"
        raise input_error(sequence.path, expected, f"{theirs.width}x{theirs.height}", "pass the same sequence.")


def _facts_of(
    scene: RenderedScene, sequence: FrameSequence, split: Split, fingerprints: Fingerprints
) -> dict[str, str]:
    """What the protocol says of a scene: how it is rendered, and what it was trained on."""
    fps = f"{FPS_RENDERS} renders of the sequence's frames, one after the other, or as many as end in "
    facts = {"backend": scene.backend, "fps": f"{fps}{LONGEST_SECONDS:g} s; {name_of(scene.device)}"}
    if any(scene.smoke_at(i / len(sequence)) is not None for i in sequence.indices(split)):
        facts["smoke"] = "images as filmed: held-out frames through smoke interpolated between training frames"
    if scene.trained_on and scene.trained_on.images and fingerprints.images:
        facts["trained_on"] = _trained_on(scene.trained_on, fingerprints, sequence.path)
    return facts


def _trained_on(trained: Fingerprints, scored: Fingerprints, data: Path) -> str:
    """What a scene was trained on, in words; a warning where that is another video than it is scored on.

    Masks that were corrected, or depth that was added, belong to the same video.
    """
    if trained == scored:
        return SAME_FILES
    if trained.images == scored.images:
        return SAME_IMAGES
    ours, theirs = (each.images[:SHOWN_DIGITS] for each in (trained, scored))
    expected, got = f"the images that the scene was trained on (SHA-256 {ours}...)", f"others ({theirs}...)"
    fix = "`endoprior eval RUN --data FOLDER` with those images."
    log.warning("warning: %s", input_error(data, expected, got, fix))
    return OTHER_IMAGES


def scored_data(trained: DataConfig) -> DataConfig:
    """How frames are read to score a scene: those it was trained on, with depth as it was measured."""
    return replace(trained, lift_missing_depth=False)


def _protocol(sequence: FrameSequence, split: Split, data: DataConfig) -> dict[str, Any]:
    unit = "relative units: the depth's scale is assumed" if sequence.depth_is_relative else "mm"
    return {
        "split": split,
        "split_rule": sequence.split_rule,
        "frames": sequence.indices(split),
        "images": "8-bit round trip; psnr, ssim, lpips and flow on images multiplied by the tissue mask",
        "shrink": data.shrink,
        "masks": f"{'gt_masks/' if data.use_gt_masks else 'masks/'} of the sequence, tissue = not tool",
        "strict_*": "rendered color, not rounded to 8 bits; tissue pixels only; flow: flow_error_dis_adjacent",
        "depth_rmse_endogaussian": "8-bit depths that wrap, only to compare with that paper's tables",
        "depth": "sum of weight * z against measured depth on tissue, mean of per-frame RMSE; " + unit,
        "flow_error": "consecutive frames of the split; *_adjacent: all adjacent frames of the video",
        "track_*": "all frames of the video; *_dis: optical flow chained over them, held-out frames included",
        "deformation_*": "all frames of the video since the first; *_dis: chained flow, held-out frames included",
        "range_held_*": "all frames of the video; points picked on the surface in the first frame that shows them",
        "ate_mm": "all frames of the video; aligned by a rigid motion, or a similarity where depth is relative",
        "right_*": "tissue that both eyes see by measured depth; right pictures as they are, left mask",
        "poses": "of the scene",
        "depth_instability_mm": "all adjacent frames of the video",
    }
