"""Judging each iteration before its update without making a device wait for the host.

On the CPU the judgment is there at once, and an unusable iteration raises before anything changes. On a device the
verdict is a number that stays there: from the first unusable iteration on it is 1, and optimizer and statistics, which
read it there, leave everything as it is. The host looks at what has piled up every `LOOK_EVERY` iterations, and raises
then: the state is the same, only the clock has gone on.
"""

from __future__ import annotations

import time as clock
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from .divergence import LARGEST_GRADIENT, Diverged, Watch, check_largest, check_step
from .state import Losses

if TYPE_CHECKING:
    from .optimizer import Optimizer

LOOK_EVERY = 20
"""Iterations that a device may be ahead: each look costs one wait, each iteration ahead some wasted work."""


class Redo(Exception):
    """Iterations that a device could not do must be done again; the state is the one before the first of them."""

    def __init__(self, ago: int) -> None:
        super().__init__()
        self.ago = ago
        """Iterations that were begun after that one."""


@dataclass(frozen=True)
class Evidence:
    """What one iteration leaves to be judged by."""

    losses: Losses
    names: tuple[str, ...] = ()
    largest: Tensor | None = None
    """(len(names),) on a device: largest magnitude of each gradient. None where it was judged at once."""
    frozen: Tensor | None = None
    """() on a device: 1 if this iteration, or one before, changed nothing."""

    def copied(self) -> Evidence:
        """The same numbers in memory of their own."""
        losses = Losses(self.losses.names, self.losses.values.clone())
        return Evidence(losses, self.names, self.largest.clone(), self.frozen.clone())


class Inspector:
    """Sees every iteration of one run, in order."""

    def __init__(self, device: torch.device, *, waits: bool) -> None:
        """Begin with a clean record.

        Args:
            device: where losses and gradients lie.
            waits: judge at once; else now and then.
        """
        self.frozen: Tensor | None = None if waits else torch.zeros((), device=device)
        """() float32 on the device, 1 once an iteration was unusable; None where each is judged at once."""
        self._watch = Watch()
        self._pending: list[tuple[Evidence, float]] = []
        self._looked_at, self._pace = clock.perf_counter(), 0.0

    def judge(
        self, losses: Losses, optimizer: Optimizer, brightness: float, incomplete: Tensor | None = None
    ) -> Evidence:
        """Judge an iteration by its loss and the gradients that the optimizer is about to use; waits for nothing.

        Args:
            brightness: see `Watch.see`.
            incomplete: () bool on a device, whether the picture must be drawn again.
        Raises:
            Diverged: where each is judged at once: this iteration is not usable.
        """
        if self.frozen is None:
            check_step(losses.numbers, optimizer.count_unusable())
            self._watch.see(losses.numbers["color"], brightness)
            return Evidence(losses)
        found = optimizer.largest_gradients()
        largest = torch.stack(list(found.values()))
        usable = losses.values.isfinite().all() & (largest <= float(LARGEST_GRADIENT)).all()
        if incomplete is not None:
            usable = usable & ~incomplete
        self.frozen.copy_(torch.maximum(self.frozen, (~usable).float()))
        return Evidence(losses, tuple(found), largest, self.frozen.clone())

    def note(self, evidence: Evidence, brightness: float, *, look: bool) -> None:
        """Take in an iteration that was judged, and done unless it was unusable.

        Args:
            look: wait for the device now, whatever the habit: what follows cannot be taken back.
        Raises:
            Diverged, Redo: as `look`.
        """
        if evidence.largest is None:
            return
        self._pending.append((evidence, brightness))
        if look or len(self._pending) >= LOOK_EVERY:
            self.look()

    def look(self) -> None:
        """Wait for the device and judge what has piled up.

        Raises:
            Diverged: with `ago`, how many iterations were begun after the one it is about.
            Redo: some were not done although nothing is wrong with them.
        """
        pending, self._pending = self._pending, []
        if not pending:
            return
        parts = [torch.cat([e.losses.values, e.largest, e.frozen[None]]) for e, _ in pending]
        numbers = iter(torch.cat(parts).tolist())
        now = clock.perf_counter()
        self._pace, self._looked_at = (now - self._looked_at) / len(pending), now
        for ago, (evidence, brightness) in zip(reversed(range(len(pending))), pending, strict=True):
            terms = {name: next(numbers) for name in evidence.losses.names}
            largest = {name: next(numbers) for name in evidence.names}
            try:
                check_largest(terms, largest)
                if next(numbers):
                    raise Redo(ago)
                self._watch.see(terms["color"], brightness)
            except (Diverged, Redo) as news:
                self.frozen.zero_()  # who goes on does so from the state before
                news.ago = ago
                raise

    def seconds(self, since: float) -> float:
        """Time of an iteration that began at `since` (perf_counter); on a device the mean up to the last look."""
        return clock.perf_counter() - since if self.frozen is None else self._pace
