"""The texture prior on generated images: range, masks, symmetries; and the sampling distribution of Eq. (6)."""

from __future__ import annotations

from dataclasses import replace
from unittest import mock

import numpy as np
import pytest
from frame_strategies import SEEDS, SIDES, frames, masks, pictures
from hypothesis import given
from hypothesis import strategies as st
from hypothesis_profiles import examples

from endoprior.core.config import InitConfig
from endoprior.core.geometry import FARTHEST_MM
from endoprior.initialization import sampling
from endoprior.initialization.sampling import eroded_mask, pixel_probability, sampling_distribution
from endoprior.priors import edge_magnitude, joint_texture_prior, salience, specular_likelihood


@st.composite
def inputs(draw):
    """Color in [0, 1] and a tissue mask of one size, with a border rule."""
    height, width = draw(SIDES), draw(SIDES)
    rgb = draw(pictures(height, width)).astype(np.float32) / np.float32(255)
    return rgb, draw(masks(height, width)), draw(st.sampled_from(["reflect", "zero"]))


@given(inputs())
def test_prior_and_cues_lie_in_0_to_1_and_are_0_on_tools(made):
    rgb, mask, border = made
    rho = joint_texture_prior(rgb, mask, border=border)
    for value in (rho, specular_likelihood(rgb), salience(rgb, mask, border)):
        assert value.dtype == np.float32 and value.shape == mask.shape
        assert np.isfinite(value).all() and value.min() >= 0 and value.max() <= 1
    assert (rho[~mask] == 0).all()
    assert (rho <= salience(rgb, mask, border)).all()


@examples(50)
@given(inputs(), st.sampled_from(["left-right", "up-down", "transpose"]))
def test_prior_of_a_mirrored_image_is_the_mirrored_prior(made, how):
    rgb, mask, border = made

    def mirrored(image):
        return {"left-right": image[:, ::-1], "up-down": image[::-1], "transpose": image.swapaxes(0, 1)}[how]

    got = joint_texture_prior(mirrored(rgb), mirrored(mask), border=border)
    want = mirrored(joint_texture_prior(rgb, mask, border=border))
    # Sobel's sums round in another order: 1e-7 of gray beside a percentile that may be next to nothing.
    strong = np.percentile(edge_magnitude(rgb @ [0.299, 0.587, 0.114], border)[mask], 50) if mask.any() else 1
    if strong > 1e-2:
        np.testing.assert_allclose(got, want, atol=1e-4)
    assert ((got > 0) & ~mirrored(mask)).sum() == 0


@given(SIDES, SIDES, SEEDS, st.floats(0, 1))
def test_constant_and_clipped_images_have_no_prior(height, width, seed, gray):
    mask = np.random.default_rng(seed).random((height, width)) < 0.8
    constant = np.full((height, width, 3), gray, np.float32)
    assert joint_texture_prior(constant, mask).max() == 0  # reflected borders are no edges
    noise = np.random.default_rng(seed).random((height, width, 3)).astype(np.float32)
    clipped = np.maximum(noise, np.float32([0.93, 0.93, 0.0]))  # two channels beyond tau_o
    assert joint_texture_prior(clipped, mask).max() == 0


@given(inputs())
def test_masked_pixels_do_not_change_the_scale(made):
    """E divides by a percentile over the tissue alone: the prior there is the same whatever tools far away show."""
    rgb, mask, border = made
    near = np.pad(mask, 1)
    touched = np.zeros_like(mask)
    for dy in range(3):
        for dx in range(3):
            touched |= near[dy : dy + mask.shape[0], dx : dx + mask.shape[1]]
    other = np.where(touched[..., None], rgb, np.float32(1) - rgb)
    np.testing.assert_array_equal(
        joint_texture_prior(other, mask, border=border), joint_texture_prior(rgb, mask, border=border)
    )


@given(inputs(), st.sampled_from([0.0, 0.45, 1.0]), st.sampled_from([1, 3, 9, 101]))
def test_sampling_probabilities_sum_to_1_inside_the_eroded_mask(made, uniform, erosion):
    rgb, mask, _ = made
    with mock.patch.object(sampling, "EROSION_PX", erosion):
        probability = sampling_distribution(joint_texture_prior(rgb, mask), mask, uniform)
    assert np.isfinite(probability).all() and (probability >= 0).all()
    inside = eroded_mask(mask, erosion)
    assert (inside <= mask).all() and inside.any() == mask.any()
    assert (probability[~inside] == 0).all()
    assert probability.sum() == pytest.approx(1.0 if mask.any() else 0.0, abs=1e-9)
    if uniform > 0:
        assert (probability[inside] > 0).all()


@given(frames(), st.sampled_from(["prior", "uniform", "pool"]), st.booleans())
def test_pixels_without_tissue_or_usable_depth_are_never_sampled(frame, sampler, released):
    cfg = InitConfig(sampler=sampler)
    weights = pixel_probability(frame, cfg, released)
    assert np.isfinite(weights).all() and (weights >= 0).all()
    too_near_or_far = (frame.depth <= 0.2) | (frame.depth >= FARTHEST_MM)
    assert (weights[~frame.tissue_mask | ~frame.depth_valid | too_near_or_far] == 0).all()
    darker = replace(frame, rgb_u8=np.zeros_like(frame.rgb_u8))
    assert (pixel_probability(darker, cfg, released) > 0).any() >= (weights > 0).any()
