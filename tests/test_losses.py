"""Supervised terms: closed forms, and the fused kernel against the definition."""

from types import SimpleNamespace

import pytest
import torch

from endoprior.core.config import LossConfig
from endoprior.core.types import RenderOutput
from endoprior.training import losses
from endoprior.training.losses import supervised_losses_numba as supervised_losses
from endoprior.training.losses import supervised_terms


def scene(seed: int, height: int = 13, width: int = 17):
    """Random colors and depths, some of them not drawn, and targets with holes."""
    g = torch.Generator().manual_seed(seed)
    color = torch.rand(height, width, 3, generator=g)
    depth = torch.rand(height, width, generator=g) * 60 + 40
    depth[torch.rand(height, width, generator=g) < 0.1] = 0
    target_u8 = torch.randint(0, 256, (height, width, 3), generator=g, dtype=torch.uint8)
    target_inverse = 1 / (torch.rand(height, width, generator=g) * 60 + 40)
    tissue = torch.rand(height, width, generator=g) < 0.8
    measured = tissue & (torch.rand(height, width, generator=g) < 0.9)
    return color, depth, target_u8, target_inverse, tissue, measured


def test_color_l1_of_a_constant_offset_is_the_offset():
    target, mask = torch.rand(5, 6, 3), torch.ones(5, 6, dtype=torch.bool)
    mask[0] = False
    color = target + 0.25
    color[0] = 9  # not tissue: must not count
    assert losses.color_l1(color, target, mask).item() == pytest.approx(0.25, abs=1e-6)


def test_edges_are_differences_of_the_error_between_two_pixels_of_tissue():
    """An even error costs nothing, a step of it counts where both of its sides are tissue."""
    target, mask = torch.rand(4, 5, 3), torch.ones(4, 5, dtype=torch.bool)
    assert losses.edge_l1(target + 0.25, target, mask).item() == pytest.approx(0, abs=1e-6)
    error = torch.zeros(4, 5, 3)
    error[:, 2:] = 0.5  # a step in each of 4 rows
    assert losses.edge_l1(target + error, target, mask).item() == pytest.approx(4 * 0.5 / 20, abs=1e-6)
    mask[0, 2] = mask[1, 1] = False  # two of the steps end beside tissue
    assert losses.edge_l1(target + error, target, mask).item() == pytest.approx(2 * 0.5 / 18, abs=1e-6)


def test_inverse_depth_keeps_zero_where_nothing_is_drawn():
    depth = torch.tensor([[0.0, 2.0]], requires_grad=True)
    inverse = losses.inverse_depth(depth)
    assert inverse.tolist() == [[0.0, 0.5]]
    inverse.sum().backward()
    assert depth.grad.tolist() == [[0.0, -0.25]]


def test_total_variation_of_a_step():
    image = torch.zeros(4, 4)
    image[:, 2:] = 1  # one jump in each of 4 rows, 16 values
    assert losses.total_variation(image).item() == pytest.approx(4 / 16)


def test_total_variation_is_the_double_loop():
    image = torch.rand(5, 7, 3)
    total = 0.0
    for y in range(5):
        for x in range(7):
            for c in range(3):
                total += abs(image[y + 1, x, c] - image[y, x, c]).item() if y < 4 else 0
                total += abs(image[y, x + 1, c] - image[y, x, c]).item() if x < 6 else 0
    assert losses.total_variation(image).item() == pytest.approx(total / image.numel(), rel=1e-5)


def test_total_variation_leaves_out_differences_between_two_such_pixels():
    image = torch.tensor([[0.0, 1.0, 3.0], [7.0, 15.0, 31.0]])
    left_out = torch.tensor([[True, True, False], [False, True, True]])
    # right: 2 (1 -> 3), 8 (7 -> 15); down: 7 (0 -> 7), 28 (3 -> 31); left out: 0 -> 1, 15 -> 31, 1 -> 15.
    assert losses.total_variation(image, left_out).item() == pytest.approx((2 + 8 + 7 + 28) / 6)
    everywhere = torch.ones_like(left_out)
    assert losses.total_variation(image, everywhere) == 0
    assert losses.total_variation(image, ~everywhere) == losses.total_variation(image)


def weighted_scene(seed: int):
    """The same with weights in [0, 1] in place of masks, some of them 0."""
    *images, tissue, measured = scene(seed)
    weight = (torch.rand(tissue.shape, generator=torch.Generator().manual_seed(seed)) * 1.5 - 0.25).clamp(0, 1)
    return *images, tissue * weight, measured * weight


def test_weights_are_those_of_a_weighted_sum_and_a_frame_of_half_weight_counts_half():
    color, _, target, _, tissue, _ = scene(5)
    weight = torch.rand(tissue.shape, generator=torch.Generator().manual_seed(6)) * 0.9 + 0.1
    target = target / 255
    error = (color - target).abs().sum(-1)
    wanted = sum(float(error[y, x] * weight[y, x]) for y, x in torch.nonzero(tissue).tolist()) / (3 * int(tissue.sum()))
    assert losses.color_l1(color, target, tissue * weight).item() == pytest.approx(wanted, rel=1e-5)
    half = losses.color_l1(color, target, tissue * 0.5)
    assert half.item() == pytest.approx(0.5 * losses.color_l1(color, target, tissue).item(), rel=1e-5)


@pytest.mark.parametrize("made", [scene, weighted_scene])
@pytest.mark.parametrize("tv_on_tissue", [True, False])
@pytest.mark.parametrize("seed", range(4))
def test_fused_terms_and_gradients_agree_with_the_torch_implementation(seed, tv_on_tissue, made):
    color, depth, *rest = made(seed)
    weights = (1.0, 0.7, 0.03, 0.4)
    grads, values = [], []
    for function in (losses.supervised_losses, supervised_losses):
        c, d = color.clone().requires_grad_(), depth.clone().requires_grad_()
        terms = function(c, d, *rest, weights, tv_on_tissue)
        terms.sum().backward()
        values.append(terms.detach())
        grads.append((c.grad, d.grad))
    # float32 sums over some hundred pixels in another order
    torch.testing.assert_close(values[1], values[0], rtol=1e-5, atol=1e-7)
    torch.testing.assert_close(grads[1][0], grads[0][0], rtol=1e-5, atol=1e-8)
    torch.testing.assert_close(grads[1][1], grads[0][1], rtol=1e-4, atol=1e-10)


def test_fused_terms_refuse_to_be_scaled():
    color, depth, *rest = scene(0)
    terms = supervised_losses(color.requires_grad_(), depth, *rest, (1.0, 1.0, 1.0, 1.0))
    with pytest.raises(ValueError, match="got one that is scaled or left out"):
        (2 * terms).sum().backward()


def test_fused_terms_of_a_frame_without_tissue_are_finite():
    color, depth, target, inverse, tissue, measured = scene(1)
    nothing = torch.zeros_like(tissue)
    terms = supervised_losses(color, depth, target, inverse, nothing, nothing & measured, (1.0, 1.0, 0.0, 1.0))
    assert terms.tolist() == [0, 0, 0, 0]


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1)])
def test_fused_terms_of_degenerate_images(shape):
    color, depth, *rest = scene(2, *shape)
    args = (color, depth, *rest, (1.0, 1.0, 1.0, 1.0))
    torch.testing.assert_close(supervised_losses(*args), losses.supervised_losses(*args), rtol=1e-5, atol=1e-7)


def test_holes_cost_only_where_tissue_is_hidden():
    color, depth, target, inverse, tissue, measured = scene(3)
    alpha = torch.rand(tissue.shape, generator=torch.Generator().manual_seed(4)).requires_grad_()
    hidden = ~tissue & (torch.arange(tissue.shape[1]) < 9)
    frame = SimpleNamespace(
        rgb_u8=target,
        inverse_depth=inverse,
        tissue_mask=tissue,
        hidden=hidden,
        measured=measured,
        num_measured=100,
        counted=lambda mask: mask,
        counted_depth=measured,
    )
    out = RenderOutput(color, alpha, depth, torch.zeros(0, 2), torch.zeros(0))
    assert "cover" not in supervised_terms(out, frame, LossConfig(cover_weight=0.0), supervised_losses)
    term = supervised_terms(out, frame, LossConfig(cover_weight=0.5), supervised_losses)["cover"]
    assert term.item() == pytest.approx(0.5 * (1 - alpha[hidden]).sum().item() / alpha.numel(), rel=1e-5)
    term.backward()
    assert (alpha.grad[hidden] < 0).all() and not alpha.grad[~hidden].any()
