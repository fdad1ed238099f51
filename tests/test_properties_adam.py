"""Adam's kernels on generated gradients: steps stay finite and short, whatever follows whatever."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis_profiles import examples

from endoprior.model.gaussians import RankOneGradient
from endoprior.training.adam import BETA1, BETA2, AdamState
from endoprior.training.ops import NUMBA

LONGEST_STEP = (1 - BETA1) / np.sqrt(1 - BETA2) / np.sqrt(1 - BETA1**2 / BETA2)
"""In learning rates: 7.3, by Cauchy and Schwarz over all sequences of gradients; test_divergence.py comes close."""
LARGEST = 15.0
"""log10 of the largest gradient that training lets through."""


def gradients(rng, shape):
    """Float32 of both signs over all magnitudes, zeros among them."""
    values = 10.0 ** rng.uniform(-45, LARGEST, shape) * rng.choice([-1.0, 0.0, 1.0], shape)
    return values.astype(np.float32)


@given(st.integers(0, 2**31 - 1), st.integers(0, 70), st.integers(1, 25), st.sampled_from([1e-15, 1e-8]))
def test_a_step_is_finite_and_never_longer_than_it_can_be(seed, num, steps, epsilon):
    rng, rate = np.random.default_rng(seed), 1e-2
    param = torch.zeros(num, requires_grad=True)
    state = AdamState(param)
    for _ in range(steps):
        before = param.detach().clone()
        param.grad = torch.from_numpy(gradients(rng, num))
        NUMBA.adam_step([state], [param], rate, epsilon)
        assert torch.isfinite(param).all() and torch.isfinite(state.first).all() and torch.isfinite(state.second).all()
        assert ((param.detach() - before).abs() <= 1.001 * LONGEST_STEP * rate + 1e-6).all()


@examples(20)
@given(st.integers(0, 2**31 - 1), st.integers(1, 40), st.integers(2, 9), st.integers(1, 3))
def test_a_step_along_a_basis_is_that_of_the_whole_gradient(seed, num, bases, moments):
    """Sums of outer products give what their sum written out gives; bases of no weight stay."""
    rng = np.random.default_rng(seed)
    weights = [rng.random(bases).astype(np.float32) * (np.arange(bases) < bases - 1) for _ in range(moments)]
    offsets = [rng.normal(size=(num, 3)).astype(np.float32) for _ in range(moments)]
    outer, flat = (torch.zeros(num, bases, 3, requires_grad=True) for _ in range(2))
    state, plain = AdamState(outer, bases), AdamState(flat)
    found = [RankOneGradient("motion", w, torch.from_numpy(v)) for w, v in zip(weights, offsets, strict=True)]
    for _ in range(3):
        NUMBA.adam_basis_step(state, outer, found, np.full(3, 1e-2), 1e-15)
        whole = sum(np.einsum("b,nc->nbc", w, v) for w, v in zip(weights, offsets, strict=True))
        flat.grad = torch.from_numpy(whole)
        NUMBA.adam_step([plain], [flat], 1e-2, 1e-15)
    assert (outer[:, -1] == 0).all() and torch.isfinite(outer).all()
    # Sums of either sign may cancel: then the rounding decides the direction of Adam's first steps.
    clear = np.abs(whole) > 1e-3 * np.abs(whole).max()
    np.testing.assert_allclose(outer.detach().numpy()[clear], flat.detach().numpy()[clear], rtol=2e-3, atol=1e-6)
