"""Stop a training run before it goes wrong: no NaN and no infinity may ever reach a parameter.

Each iteration is checked after its gradients are known and before anything changes. That suffices: Adam moves a
parameter by at most 0.1 / sqrt(0.001) / sqrt(1 - 0.81 / 0.999) = 7.3 times its learning rate (Cauchy-Schwarz), rates
are bounded (`OptimConfig`), and gradients below `MAX_GRADIENT` have squares that float32 can hold, so that moments
and parameters stay finite.

On the CPU the result is known at once. On a device the host would have to wait for it, so it reads the results only
every `CHECK_EVERY` iterations. Until then the device itself keeps a flag, `skip`: from the first unusable iteration on
it is 1, and optimizer and statistics, which read it there, leave the state unchanged.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..core.checks import InputError

MAX_GRADIENT = 1e15  # beyond this, or without a value, a gradient means that the run has diverged
CHECK_EVERY = 20  # iterations between two checks on a device: each check makes the host wait once
WINDOW = 300  # iterations over which images that are no better than empty ones count as divergence
PARTS = 10
"""... in each of so many parts of them: a bad start, such as gray for dark frames, must not outweigh what follows."""
NO_BETTER = 0.95  # ... when their color error is this share of that of the background alone.
ALIKE = 0.02  # error of the background alone below which that is a fair guess and nothing is concluded

ADVICE = "Lower the learning rates (--optim...), or look for wrong depth and poses with `endoprior check`"
"""For a method of Gaussians."""


class Diverged(InputError):
    """Training cannot continue; the state before the iteration it is about is unchanged."""

    def __init__(self, reason: str, last_good: int = 0) -> None:
        """Args: last_good: the iteration of the stage whose state was kept, where a check tells."""
        super().__init__(reason)
        self.last_good = last_good


def unusable_numbers(terms: Mapping[str, float], unusable: Mapping[str, int], advice: str = ADVICE) -> str | None:
    """What is wrong with the terms of the loss, or with gradients of so many `unusable` entries; ends with `advice`."""
    found = [f"{name} {value}" for name, value in terms.items() if not math.isfinite(value)]
    found += [f"{count:,} unusable entries in the gradient of {name}" for name, count in unusable.items() if count]
    return f"expected a finite loss and gradient; got {', '.join(found)}. {advice}" if found else None


class _Numbers(NamedTuple):
    """What an iteration is checked by; `values` may lie on a device."""

    iteration: int
    empty_error: float
    terms: tuple[str, ...]
    gradients: tuple[str, ...]
    values: Tensor
    """(terms + 1 + gradients,) weighted terms of the loss, the color error, then counts of unusable entries."""


class DivergenceCheck:
    """Checks every iteration of a run, in order."""

    def __init__(self, device: torch.device, *, blocking: bool) -> None:
        """Args: blocking: check each iteration at once, as suits a CPU; else every `CHECK_EVERY`."""
        self.skip: Tensor | None = None if blocking else torch.zeros((), device=device)
        """() float32 on the device, 1 once an iteration was unusable; None where each is checked at once."""
        self._watch = Watch()
        self._pending: list[_Numbers] = []

    def after_backward(
        self,
        iteration: int,
        terms: Mapping[str, Tensor],
        unusable: Mapping[str, int | Tensor],
        color_error: Tensor,
        empty_error: float,
        *,
        wait: bool,
    ) -> None:
        """Take in an iteration before its update; on a device the answer may come some iterations later.

        Args:
            terms: weighted terms of the loss, () each.
            unusable: entries of each gradient that are not finite or beyond `MAX_GRADIENT`, by name.
            color_error: (); empty_error: see `Watch.see`.
            wait: read the results now: what follows cannot be undone.
        Raises:
            Diverged: as `read`.
        """
        counts = [torch.as_tensor(count, dtype=torch.float64) for count in unusable.values()]
        values = torch.stack([*(value.detach().double() for value in (*terms.values(), color_error)), *counts])
        self._pending.append(_Numbers(iteration, empty_error, tuple(terms), tuple(unusable), values))
        if self.skip is not None:
            usable = values.isfinite().all() & (values[len(terms) + 1 :] == 0).all()
            self.skip.copy_(torch.maximum(self.skip, (~usable).float()))
        if self.skip is None or wait or len(self._pending) >= CHECK_EVERY:
            self.read(applied=iteration - 1)

    def read(self, applied: int) -> None:
        """Check what is pending; iteration `applied` was the last to be updated or skipped. A device is waited for.

        Raises:
            Diverged: one of them was unusable, or images show nothing.
        """
        pending, self._pending = self._pending, []
        values = iter(torch.cat([each.values for each in pending]).tolist() if pending else [])
        for each in pending:
            terms, color_error = {name: next(values) for name in each.terms}, next(values)
            unusable = {name: int(next(values)) for name in each.gradients}
            reason, last_good = unusable_numbers(terms, unusable), each.iteration - 1
            if reason is None:
                reason, last_good = self._watch.see(color_error, each.empty_error), applied
            if reason is not None:
                if self.skip is not None:
                    self.skip.zero_()  # who continues does so from the last good state
                raise Diverged(reason, last_good)


class Watch:
    """Notices a run that explains nothing: everything moved out of view, faded, or saturated."""

    def __init__(self, advice: str = ADVICE) -> None:
        self._advice = advice
        self._errors: deque[tuple[float, float]] = deque(maxlen=WINDOW)

    def see(self, color_error: float, empty_error: float) -> str | None:
        """What is wrong after one more iteration: over `WINDOW` of them no image was better than an empty one.

        Args:
            color_error: error of the image over tissue: mean absolute, or what else colors of 0 to 1 are compared by.
            empty_error: that of an image that shows only the background.
        """
        self._errors.append((color_error, empty_error))
        if len(self._errors) < WINDOW:
            return None
        errors = np.array(self._errors)
        error, empty = errors.mean(0)
        if empty <= ALIKE or error < NO_BETTER * empty:  # a part is better, then, too
            return None
        if any(part[:, 0].mean() < NO_BETTER * part[:, 1].mean() for part in np.array_split(errors, PARTS)):
            return None
        return (
            f"expected images that resemble the frames; over {WINDOW} iterations their mean color error was "
            f"{error:.3g}, and the background alone would have {empty:.3g}. {self._advice}"
        )
