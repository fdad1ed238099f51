"""How good the depth and masks are that `prepare` wrote: compared with a sequence of the same frames that knows better.

    python bench/prepared.py PREPARED REFERENCE [--every N]
    python bench/prepared.py film PHANTOM OUT.mp4        # the two eyes of a stereo phantom, one above the other

REFERENCE is a phantom (then its true depth is taken) or any sequence with measured depth. Prints the median absolute
error of depth on tissue (over all pixels, and of the worst frame), the share of tissue that has depth, the correlation
of the logarithms of both depths (all that relative depth can be good at), and the overlap of the tool masks.
"""

from __future__ import annotations

import argparse
import subprocess
from pathlib import Path

import imageio_ffmpeg
import numpy as np

from endoprior.data import load_sequence


def film(phantom: Path, out: Path) -> None:
    """Both eyes of a phantom as a top-bottom H.264 file, as an endoscope's recorder would write it."""
    eyes = [word for eye in ("images", "right") for word in ("-framerate", "25", "-i", str(phantom / eye / "%06d.png"))]
    encode = ["-filter_complex", "vstack", "-c:v", "libx264", "-crf", "16", "-pix_fmt", "yuv420p"]
    subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error", *eyes, *encode, str(out)], check=True)


def compare(prepared: Path, reference: Path, every: int) -> dict[str, float]:
    """The scores named above, over every `every`-th frame.

    Raises:
        SystemExit: the sequences have not as many frames of the same size.
    """
    ours, known = load_sequence(prepared), load_sequence(reference)
    if len(ours) != len(known) or ours.camera(0).width != known.camera(0).width:
        raise SystemExit(f"{prepared} and {reference}: expected as many frames of one size; got other ones")
    errors, medians, measured, tissue, correlations, both, either = [], [], 0, 0, [], 0, 0
    for i in range(0, len(ours), every):
        frame, wanted = ours.frame(i), known.frame(i)
        true = known.truth.depth(i) if known.truth else None
        depth = wanted.depth if true is None else true
        on_tissue = wanted.tissue_mask & (depth > 0)
        have = on_tissue & frame.depth_valid
        error = np.abs(frame.depth[have] - depth[have])
        errors.append(error)
        medians.append(float(np.median(error)))
        measured, tissue = measured + have.sum(), tissue + on_tissue.sum()
        correlations.append(np.corrcoef(np.log(frame.depth[have]), np.log(depth[have]))[0, 1])
        both += (~frame.tissue_mask & ~wanted.tissue_mask).sum()
        either += (~frame.tissue_mask | ~wanted.tissue_mask).sum()
    return {
        "depth_error_mm": float(np.median(np.concatenate(errors))),
        "worst_frame_mm": max(medians),
        "measured": measured / tissue,
        "log_correlation_least": float(min(correlations)),
        "log_correlation_most": float(max(correlations)),
        "tool_iou": both / max(either, 1),
    }


def main() -> None:
    """Compare, or write the film."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("words", nargs="+", metavar="PREPARED REFERENCE | film PHANTOM OUT")
    parser.add_argument("--every", type=int, default=1)
    given = parser.parse_args()
    if given.words[0] == "film":
        film(*map(Path, given.words[1:3]))
        return
    for name, value in compare(Path(given.words[0]), Path(given.words[1]), given.every).items():
        print(f"{name:<24}{value:.3f}")


if __name__ == "__main__":
    main()
