"""Generated frames: any small size, any picture, any mask, depth with everything a file can hold."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from endoprior.core.types import Camera, Frame

SEEDS = st.integers(0, 2**31 - 1)
SIDES = st.one_of(st.integers(1, 3), st.integers(4, 40))


@st.composite
def pictures(draw, height, width):
    """(H, W, 3) uint8: noise, a ramp, or constant, black, white and saturated."""
    kind = draw(st.sampled_from(["noise", "ramp", "constant", "black", "white", "red", "checker"]))
    rng = np.random.default_rng(draw(SEEDS))
    y, x = np.mgrid[:height, :width]
    picture = np.zeros((height, width, 3), np.uint8)
    if kind == "noise":
        picture = rng.integers(0, 256, (height, width, 3)).astype(np.uint8)
    elif kind == "ramp":
        picture[:] = ((x * 3 + y * 5) % 256)[..., None]
    elif kind == "constant":
        picture[:] = rng.integers(0, 256, 3)
    elif kind == "white":
        picture[:] = 255
    elif kind == "red":
        picture[..., 0] = 255
    elif kind == "checker":
        picture[:] = (255 * ((x + y) % 2))[..., None]
    return picture


@st.composite
def masks(draw, height, width):
    """(H, W) bool: all, none, one pixel, a block, noise."""
    kind = draw(st.sampled_from(["all", "none", "one", "block", "noise"]))
    rng = np.random.default_rng(draw(SEEDS))
    mask = np.full((height, width), kind == "all")
    if kind == "one":
        mask[rng.integers(height), rng.integers(width)] = True
    elif kind == "block":
        mask[: rng.integers(1, height + 1), : rng.integers(1, width + 1)] = True
    elif kind == "noise":
        mask = rng.random((height, width)) < 0.7
    return mask


@st.composite
def depths(draw, height, width):
    """(H, W) float32, mm: tissue at 30-90 mm, and in some pixels what no sensor should give."""
    rng = np.random.default_rng(draw(SEEDS))
    depth = rng.uniform(30, 90, (height, width)).astype(np.float32)
    odd = draw(st.sets(st.sampled_from([0.0, np.nan, np.inf, -np.inf, -5.0, 1e-45, 1e-3, 0.2, 1e9, 1e20, 3e38])))
    share = draw(st.sampled_from([0.0, 0.3, 1.0]))
    if odd:
        hit = rng.random((height, width)) < share
        depth[hit] = rng.choice(np.array(sorted(odd, key=str), np.float32), int(hit.sum()))
    return depth


@st.composite
def frames(draw, index=0, count=1, size=None):
    """One frame as a reader hands it on: not measured depth is 0 and marked so."""
    height, width = size or (draw(SIDES), draw(SIDES))
    depth = draw(depths(height, width))
    valid = np.isfinite(depth) & (depth > 0)
    pose = np.eye(4)
    pose[:3, 3] = draw(st.sampled_from([0.0, 3.0])), 0, draw(st.sampled_from([0.0, -7.0]))
    camera = Camera(width, height, 1.1 * width + 3, 1.2 * height + 2, 0.45 * width, 0.6 * height, pose)
    picture, mask = draw(pictures(height, width)), draw(masks(height, width))
    return Frame(index, index / count, camera, picture, mask, np.where(valid, depth, 0).astype(np.float32), valid)


@st.composite
def clips(draw, most=4):
    """1 to `most` frames of one size."""
    size, count = (draw(SIDES), draw(SIDES)), draw(st.integers(1, most))
    return [draw(frames(i, count, size)) for i in range(count)]
