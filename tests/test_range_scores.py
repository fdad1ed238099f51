"""The share of true positions inside of the ranges of carried points."""

from __future__ import annotations

import math

import numpy as np
import pytest

from endoprior.evaluation.scorers.ranges import share_held
from endoprior.model.uncertainty import Part, PointErrors

SHAPE = 100, 200
DOWN = np.tile([0.0, 1.0, 0.0], (100, 1))


def errors(scales, freedom):
    rng = np.random.default_rng(1)
    rays = rng.normal((0, 0, 3), size=(*SHAPE, 3))
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    parts = [Part(np.full(SHAPE, s), np.full(SHAPE, f)) for s, f in zip(scales, freedom, strict=True)]
    return PointErrors(rays, *parts, np.ones(SHAPE, np.float32))


def test_as_many_are_inside_as_the_range_says():
    """Errors across the ray and along it, drawn from the distributions; then half, and twice, as large."""
    rng, found, everywhere = np.random.default_rng(0), errors((0.3, 0.5, 0.0), (2.5, 4.1, 5.0)), np.ones(SHAPE, bool)
    across = 0.3 * rng.standard_t(2.5, (*SHAPE, 3))
    across -= (across * found.rays).sum(-1, keepdims=True) * found.rays
    off = across + 0.5 * rng.standard_t(4.1, (*SHAPE, 1)) * found.rays
    for level in (0.5, 0.8, 0.95):
        assert share_held(off, found, DOWN, level, everywhere) == pytest.approx(level, abs=0.03)
    assert share_held(off / 2, found, DOWN, 0.5, everywhere) > 0.7 > share_held(2 * off, found, DOWN, 0.8, everywhere)


def test_only_the_chosen_count():
    found, where = errors((0.3, 0.5, 0.0), (2.5, 4.1, 5.0)), np.zeros(SHAPE, bool)
    assert math.isnan(share_held(np.zeros((*SHAPE, 3)), found, DOWN, 0.95, where))
    off = np.full((*SHAPE, 3), 1e3)
    off[3, 4] = 0
    where[3, 4] = True
    assert share_held(off, found, DOWN, 0.95, where) == 1
