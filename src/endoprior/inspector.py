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
from .train_state import Losses

if TYPE_CHECKING:
    from .optim import Optimizer

LOOK_EVERY = 20
"""Iterations that a device may be ahead: each look costs one wait, each iteration ahead some wasted work."""


@dataclass(frozen=True)
class _Pending:
    """What is known of an iteration that nobody has looked at."""

    losses: Losses
    names: tuple[str, ...]
    largest: Tensor
    """(len(names),) largest magnitude of each gradient."""
    brightness: float


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
        self._pending: list[_Pending] = []
        self._looked_at, self._pace = clock.perf_counter(), 0.0

    def see(self, losses: Losses, optimizer: Optimizer, brightness: float, *, look: bool) -> None:
        """Judge an iteration by its loss and the gradients that the optimizer is about to use.

        Args:
            brightness: see `Watch.see`.
            look: wait for the device now, whatever the habit: what follows cannot be taken back.
        Raises:
            Diverged: this iteration is not usable, or, where nobody waits, one of the last `LOOK_EVERY` was not.
        """
        if self.frozen is None:
            check_step(losses.numbers, optimizer.count_unusable())
            self._watch.see(losses.numbers["color"], brightness)
            return
        found = optimizer.largest_gradients()
        largest = torch.stack(list(found.values()))
        unusable = ~(losses.values.isfinite().all() & (largest <= float(LARGEST_GRADIENT)).all())
        self.frozen.copy_(torch.maximum(self.frozen, unusable.float()))
        self._pending.append(_Pending(losses, tuple(found), largest, brightness))
        if look or len(self._pending) >= LOOK_EVERY:
            self.look()

    def look(self) -> None:
        """Wait for the device and judge what has piled up.

        Raises:
            Diverged: with `ago`, how many iterations were seen after the one it is about.
        """
        pending, self._pending = self._pending, []
        if not pending:
            return
        packed = torch.cat([torch.cat([p.losses.values, p.largest]) for p in pending]).tolist()
        now = clock.perf_counter()
        self._pace, self._looked_at = (now - self._looked_at) / len(pending), now
        for ago, seen in zip(reversed(range(len(pending))), pending, strict=True):
            terms, packed = packed[: len(seen.losses.names)], packed[len(seen.losses.names) :]
            largest, packed = packed[: len(seen.names)], packed[len(seen.names) :]
            try:
                check_largest(
                    dict(zip(seen.losses.names, terms, strict=True)), dict(zip(seen.names, largest, strict=True))
                )
                self._watch.see(terms[seen.losses.names.index("color")], seen.brightness)
            except Diverged as error:
                self.frozen.zero_()  # who goes on does so from the state before
                error.ago = ago
                raise

    def seconds(self, since: float) -> float:
        """Time of an iteration that began at `since` (perf_counter); on a device the mean up to the last look."""
        return clock.perf_counter() - since if self.frozen is None else self._pace
