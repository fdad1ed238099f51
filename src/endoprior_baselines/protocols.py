"""What the evaluation script of each compared method does, as data. Explained in docs/scores.md; figures:
docs/results.md.

Facts were read in the released programs at these commits: EndoNeRF 5201b1e, EndoSurf 2b33413, EndoGS 72ca45a, Endo-4DGS
39c6ce2, Deform3DGS b06f0a5, SurgicalGaussian c0ac51a; EndoGaussian at the version that scores with AlexNet.
"""

from __future__ import annotations

from endoprior.evaluation.protocols.table import Protocol

SEEN = (("split", "all frames but the first"), ("saw_test_frames", "yes: all of them"))
HELD_OUT = (("split", "test, the same rule"),)

ENDONERF = Protocol(
    "EndoNeRF",
    "Wang et al., MICCAI 2022; eval_rgb.py",
    masks="gt_masks, else masks",
    skips_first=True,
    pooled=True,
    lpips_lowest=0,
    paper=(*SEEN, ("background", "none: a radiance field")),
    differs=(
        "The script takes the mask folder as an argument; the command in its README names gt_masks.",
        "How that program rounds color to 8 bits was not established; here to the nearest value.",
    ),
)
ENDOSURF = Protocol(
    "EndoSurf",
    "Zha et al., MICCAI 2023; src/trainer/utils.py",
    masks="masks",
    rounded=False,
    over_frame=False,
    pooled=True,
    ssim_valid=True,
    lpips="vgg",
    depth="mm, pooled",
    paper=(*HELD_OUT, ("saw_test_frames", "by the bounding sphere"), ("background", "none: a radiance field")),
    differs=(
        "Depth is scored wherever it is measured on tissue; the script also drops percentiles of the whole video.",
        "LPIPS is the mean of frames; the script averages pairs, so the last of an odd number counts twice.",
    ),
)
ENDOGS = Protocol(
    "EndoGS",
    "Zhu et al., arXiv 2401.11535; eval_rgb.py",
    masks="gt_masks, else masks",
    skips_first=True,
    kept_rows=500,
    over_frame=False,
    pooled=True,
    lpips_lowest=0,
    paper=(*SEEN, ("background", "white")),
)
ENDO4DGS = Protocol(
    "Endo-4DGS",
    "Huang et al., MICCAI 2024; metrics.py",
    masks="masks",
    lpips_lowest=0,
    paper=(*HELD_OUT, ("saw_test_frames", "no"), ("background", "black")),
)
ENDOGAUSSIAN = Protocol(
    "EndoGaussian",
    "Liu et al., arXiv 2401.12561; metrics.py",
    masks="masks",
    depth="8-bit, all pixels",
    paper=(*HELD_OUT, ("saw_test_frames", "no"), ("background", "black")),
)
DEFORM3DGS = Protocol(
    "Deform3DGS",
    "Yang et al., MICCAI 2024; metrics.py",
    masks="masks",
    depth="8-bit, tissue",
    paper=(*HELD_OUT, ("saw_test_frames", "by the initialization"), ("background", "black")),
)
SURGICALGAUSSIAN = Protocol(
    "SurgicalGaussian",
    "Xie et al., MICCAI 2024; metrics.py",
    masks="gt_masks",
    masked_rows=12,
    lpips_lowest=0,
    paper=(*HELD_OUT, ("saw_test_frames", "by the initialization"), ("background", "white")),
    differs=("Its depth figures (of scaled depth, and of depth divided by 100) are not computed.",),
)
