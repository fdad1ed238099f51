"""The motion basis: offsets, their gradient and the optimizer's step, beside one einsum and torch.optim.Adam.

`python bench/basis.py [--quick] [--json FILE]`
"""

from __future__ import annotations

import common
import plain
import torch

from endoprior.core.presets import preset
from endoprior.model.basis import RankOneGradient, basis_offsets, identity_motion
from endoprior.model.deformation import Offsets
from endoprior.training.adam import AdamState
from endoprior.training.optimizer import motion_rates

MOMENT = 0.4


def measure(sizes: tuple[common.Size, ...]) -> list[common.Row]:
    """Three rows for each number of Gaussians: forward, backward, update."""
    cfg = preset("default").fitted(68)
    deformation, epsilon = cfg.deformation, cfg.optim.epsilon
    rates = motion_rates(cfg, 1, cfg.optim.decay_iterations)
    measured = []
    for num in common.nums(sizes):
        motion = identity_motion(num, deformation).requires_grad_()
        other = motion.detach().clone().requires_grad_()
        state, adam = AdamState(motion, deformation.basis.num_bases), plain.Adam([other], epsilon)
        sink: list[RankOneGradient] = []

        def update(_: object, motion=motion, state=state, sink=sink) -> None:
            state.update_bases(motion, sink, rates, epsilon)
            sink.clear()

        ours = {
            "forward": lambda _, m=motion, s=sink: basis_offsets(m, MOMENT, deformation, s),
            "backward": pull,
            "update": update,
        }
        theirs = {
            "forward": lambda _, m=other: plain.basis_offsets(m, MOMENT, deformation),
            "backward": pull,
            "update": lambda _, a=adam: a.step(),
        }
        measured += common.rows("motion basis", common.race(ours, theirs), num)
    return measured


def pull(offsets: Offsets) -> None:
    """Backward from all offsets, with cotangents 1."""
    found = [value for value in vars(offsets).values() if value is not None]
    torch.autograd.backward(found, [torch.ones_like(value) for value in found])


if __name__ == "__main__":
    common.main(measure, __doc__)
