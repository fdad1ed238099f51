"""Stop a training run before it goes wrong: no NaN and no infinity may ever reach a parameter.

Each iteration is judged after its gradients are known and before anything is changed. That suffices: Adam moves a
parameter by at most 0.1 / sqrt(0.001) / sqrt(1 - 0.81 / 0.999) = 7.3 times its learning rate (Cauchy-Schwarz), rates
are bounded (`OptimConfig`), and gradients below `LARGEST_GRADIENT` have squares that float32 can hold, so that moments
and parameters stay finite.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numba import njit, prange

from ..compute.compiled import compiled
from ..core.checks import InputError

if TYPE_CHECKING:
    from torch import Tensor

LARGEST_GRADIENT = np.float32(1e15)
"""Beyond this, or without a value, a gradient means that the run has diverged."""
WINDOW = 300
"""Iterations over which a picture that is no better than black counts as divergence."""
NO_BETTER = 0.95
"""... when its color error is this share of black's."""
DARK = 0.02
"""Mean brightness of the frames, 0..1, below which black is a fair guess and nothing is concluded."""

ADVICE = "Lower the learning rates (--optim...), or look for wrong depth and poses with `endoprior check`"


class Diverged(InputError):
    """Training cannot go on; the state before the iteration it is about is untouched."""

    ago: int = 0
    """Iterations that were begun after that one: on a device the host looks only now and then."""


def check_step(terms: Mapping[str, float], unusable: Mapping[str, int]) -> None:
    """Refuse an iteration whose loss or gradients are not usable numbers.

    Args:
        terms: weighted terms of the loss.
        unusable: entries of each gradient that `count_unusable` counted, by name.
    Raises:
        Diverged: a term is not finite, or a gradient has such an entry.
    """
    counted = [f"{count:,} unusable entries in the gradient of {name}" for name, count in unusable.items() if count]
    _refuse(terms, counted)


def check_largest(terms: Mapping[str, float], largest: Mapping[str, float]) -> None:
    """`check_step`, where of each gradient the largest magnitude is known; NaN stands for any NaN."""
    limit = float(LARGEST_GRADIENT)
    _refuse(terms, [f"{value:.3g} in the gradient of {name}" for name, value in largest.items() if not value <= limit])


def _refuse(terms: Mapping[str, float], unusable: list[str]) -> None:
    found = [f"{name} {value}" for name, value in terms.items() if not math.isfinite(value)] + unusable
    if found:
        raise Diverged(f"expected a finite loss and gradient; got {', '.join(found)}. {ADVICE}")


def count_unusable(gradient: Tensor) -> int:
    """Number of entries of a float32 tensor that are NaN, infinite, or beyond `LARGEST_GRADIENT`."""
    if not compiled(gradient):
        return int((~(gradient.detach().abs() <= float(LARGEST_GRADIENT))).sum())
    return int(_count(gradient.detach().contiguous().reshape(-1).numpy(), LARGEST_GRADIENT))


def count_unusable_rows(gradients: Tensor, marks: Tensor, mark: int) -> int:
    """The same over the rows (n, C) float32, contiguous, whose entry of `marks` (n,) uint8 has the bits of `mark`."""
    if not compiled(gradients):  # other rows hold zeros
        return count_unusable(gradients)
    return int(_count_rows(gradients.detach().numpy(), marks.numpy(), mark, LARGEST_GRADIENT))


@njit(parallel=True, cache=True)
def _count(values, limit):
    bad = 0
    for i in prange(values.size):
        if not abs(values[i]) <= limit:
            bad += 1
    return bad


@njit(parallel=True, cache=True)
def _count_rows(values, marks, mark, limit):
    bad = 0
    for i in prange(values.shape[0]):
        found = 0
        if marks[i] & mark:
            for c in range(values.shape[1]):
                if not abs(values[i, c]) <= limit:
                    found += 1
        bad += found
    return bad


class Watch:
    """Notices a run that explains nothing: everything flew away, faded out, or burns."""

    def __init__(self) -> None:
        self._errors: deque[tuple[float, float]] = deque(maxlen=WINDOW)

    def see(self, color_error: float, brightness: float) -> None:
        """Take in one iteration.

        Args:
            color_error: mean absolute error of the picture over tissue.
            brightness: mean of the frame over tissue, in [0, 1]: the error that a black picture has.
        Raises:
            Diverged: over the last `WINDOW` iterations the pictures were no better than black ones.
        """
        self._errors.append((color_error, brightness))
        if len(self._errors) < WINDOW:
            return
        error, black = np.mean(self._errors, axis=0)
        if black > DARK and error >= NO_BETTER * black:
            raise Diverged(
                f"expected pictures that resemble the frames; over {WINDOW} iterations their mean color error was "
                f"{error:.3g}, and black pictures would have {black:.3g}. {ADVICE}"
            )
