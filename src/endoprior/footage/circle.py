"""The circle of a round border, and the fit of circles to outline points of which many are wrong.

Shared letters: `P` points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

HYPOTHESES = 6000
"""Number of circles through three random points."""
SCORED = 300
"""Number of plausible ones to compare with all points."""
MOST_POINTS = 1500
"""Number of random points used for the comparison."""
TOLERANCE = 0.012
"""Distance from the circle, in radii, beyond which a point does not count."""
FACING = 0.9
"""Smallest cosine between the direction to the center and the direction in which the image becomes brighter."""
UNMEASURED_RIM = 0.025
"""Share of the radius that is left out of a circle whose rim was not measured."""


@dataclass(frozen=True)
class Circle:
    """The round border of the endoscope image, px; the center of the top-left pixel is (0.5, 0.5)."""

    center_x: float
    center_y: float
    radius: float
    rim_px: float | None = None
    """Width inside of the radius that shows no tissue in every image: lit or blurred rim, and movement of the border.
    None: not measured."""
    agreement: float = 1.0
    """Share 0..1 of the visible circle on which the images show a border; dark parts do not count."""

    @property
    def margin_px(self) -> float:
        """Width inside of the radius to leave out, px."""
        return UNMEASURED_RIM * self.radius if self.rim_px is None else self.rim_px

    def mask(self, width: int, height: int, margin_px: float = 0.0) -> NDArray[np.bool_]:
        """(H, W) True inside the circle with its radius reduced by `margin_px`."""
        x = np.arange(width) + 0.5 - self.center_x
        y = np.arange(height)[:, None] + 0.5 - self.center_y
        return x * x + y * y < max(self.radius - margin_px, 0.0) ** 2


def likely_circle(points: NDArray[np.float64], inward: NDArray[np.float64], width: int, height: int) -> Circle | None:
    """The circle that most outline points lie on: random sample consensus, then a robust fit. Deterministic.

    Args:
        points: (P, 2) x, y, px.
        inward: (P, 2) unit vectors in which the image becomes brighter.
        width, height: of the image, px.
    """
    if len(points) < 20:
        return None
    rng = np.random.default_rng(0)
    triples = rng.integers(0, len(points), (HYPOTHESES, 3))
    circles = _through(points[triples])
    x, y, radius = circles.T
    with np.errstate(invalid="ignore"):
        plausible = (radius > 0.25 * min(width, height)) & (radius < np.hypot(width, height))
        plausible &= (np.abs(x - width / 2) < 0.5 * width) & (np.abs(y - height / 2) < 0.5 * height)
        facing = ((circles[:, None, :2] - points[triples]) * inward[triples]).sum(-1) > FACING * radius[:, None]
    circles = circles[plausible & facing.all(1)][:SCORED]
    if not len(circles):
        return None
    chosen = rng.permutation(len(points))[:MOST_POINTS]
    best = circles[int(np.argmax([_weights(c, points[chosen], inward[chosen]).sum() for c in circles]))]
    for _ in range(5):
        weights = _weights(best, points, inward)
        if np.count_nonzero(weights) < 10:
            return None
        best = fit_circle(points, weights)
    return Circle(*(float(v) for v in best)) if np.isfinite(best).all() else None


def fit_circle(points: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Center x, y and radius of the circle through (P, 2) points, by weighted linear least squares on x^2 + y^2."""
    middle = points.mean(0)
    moved = points - middle
    root = np.sqrt(weights)[:, None]
    a = np.c_[2 * moved, np.ones(len(moved))]
    x, y, c = np.linalg.lstsq(root * a, root[:, 0] * (moved**2).sum(1), rcond=None)[0]
    return np.array([x + middle[0], y + middle[1], np.sqrt(max(c + x * x + y * y, 0.0))])


def _through(triples: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 3) center and radius of the circles through (N, 3, 2) points; not finite for three points on a line."""
    origin = triples[:, 0]
    b, c = triples[:, 1] - origin, triples[:, 2] - origin
    with np.errstate(divide="ignore", invalid="ignore"):
        det = 2 * (b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0])
        bb, cc = (b**2).sum(1), (c**2).sum(1)
        x, y = (c[:, 1] * bb - b[:, 1] * cc) / det, (b[:, 0] * cc - c[:, 0] * bb) / det
        return np.c_[x + origin[:, 0], y + origin[:, 1], np.hypot(x, y)]


def _weights(circle: NDArray[np.float64], points: NDArray[np.float64], inward: NDArray[np.float64]) -> NDArray:
    """(P,) 1 on the circle, falling to 0 at its tolerance; 0 where the image does not become brighter inwards."""
    to_center = circle[:2] - points
    distance = np.hypot(*to_center.T)
    off = (distance - circle[2]) / (TOLERANCE * circle[2])
    facing = (to_center * inward).sum(1) > FACING * distance
    return np.where(facing, np.maximum(1 - off * off, 0) ** 2, 0.0)
