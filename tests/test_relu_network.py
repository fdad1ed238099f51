"""Networks in blocks of rows give what plain torch gives, values and gradients."""

from __future__ import annotations

import pytest
import torch

from endoprior.compute import relu_network as module
from endoprior.compute.relu_network import relu_network, relu_network_torch

INPUTS, WIDTH, OUTPUTS, REPEATED = 5, 7, 3, 4
SKIPS = pytest.mark.parametrize("skip", [-1, 1, 2, 3], ids=lambda skip: f"skip {skip}")
SIZES = pytest.mark.parametrize("num", [0, 1, 8, 9, 30], ids=lambda num: f"{num} rows")


def network(skip: int, seed: int = 0) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Four layers; `skip` gets the first inputs again."""
    generator = torch.Generator().manual_seed(seed)
    widths = [INPUTS] + [WIDTH + REPEATED * (k == skip) for k in (1, 2, 3)]
    sizes = zip(widths, [WIDTH] * 3 + [OUTPUTS], strict=True)
    draw = lambda *shape: torch.randn(*shape, generator=generator, dtype=torch.float64).requires_grad_()  # noqa: E731
    return [(draw(outputs, inputs), draw(outputs)) for inputs, outputs in sizes]


def rows(num: int) -> torch.Tensor:
    return torch.randn(num, INPUTS, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch):
    monkeypatch.setattr(module, "BLOCK_ROWS", 8)


def test_two_layers_by_hand():
    layers = [(torch.tensor([[2.0], [-1.0]]), torch.tensor([1.0, 0.0])), (torch.ones(1, 2), torch.tensor([0.5]))]
    inputs = torch.tensor([[3.0], [-4.0]])
    assert relu_network(inputs, layers).tolist() == [[7.5], [4.5]]


@SKIPS
@SIZES
def test_values_and_gradients_are_those_of_plain_torch(skip, num):
    options = {"skip": skip, "repeated": REPEATED if skip > 0 else 0}
    found = []
    for function in (relu_network_torch, relu_network):
        inputs, layers = rows(num).requires_grad_(), network(skip)
        out = function(inputs, layers, **options)
        out.backward(torch.linspace(-1, 1, out.numel(), dtype=torch.float64).view_as(out))
        found.append([out.detach(), inputs.grad, *(each.grad for layer in layers for each in layer)])
    for plain, blocked in zip(*found, strict=True):
        torch.testing.assert_close(blocked, plain, rtol=1e-12, atol=1e-12)


@SKIPS
def test_gradients_are_right(skip):
    layers = network(skip)
    inputs = rows(9).requires_grad_()
    flat = [each for layer in layers for each in layer]

    def of(inputs, *flat):
        pairs = list(zip(flat[::2], flat[1::2], strict=True))
        return relu_network(inputs, pairs, skip=skip, repeated=REPEATED if skip > 0 else 0)

    assert torch.autograd.gradcheck(of, (inputs, *flat))


def test_without_gradients_values_are_the_same():
    layers = network(2)
    with_gradient = relu_network(rows(30), layers, skip=2, repeated=REPEATED)
    with torch.no_grad():
        without = relu_network(rows(30), layers, skip=2, repeated=REPEATED)
    assert not without.requires_grad and torch.equal(with_gradient.detach(), without)


def test_a_value_that_is_no_number_is_not_hidden():
    layers = network(-1)
    inputs = rows(9).clone()
    inputs[3] = torch.nan
    out = relu_network(inputs.requires_grad_(), layers)
    assert out[3].isnan().all() and out[:3].isfinite().all()
    out.sum().backward()
    assert layers[0][0].grad.isnan().any()


def test_two_results_before_one_gradient_do_not_mix():
    layers = network(2)
    options = {"skip": 2, "repeated": REPEATED}
    both = relu_network(rows(9), layers, **options).sum() + relu_network(2 * rows(20), layers, **options).sum()
    (found,) = torch.autograd.grad(both, layers[0][0])
    plain = relu_network_torch(rows(9), layers, **options).sum()
    plain = plain + relu_network_torch(2 * rows(20), layers, **options).sum()
    torch.testing.assert_close(found, torch.autograd.grad(plain, layers[0][0])[0])
