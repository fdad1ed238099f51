"""Families of tools: shape against closed forms, exact masks, colors that tell them apart; the default stays."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import get_args

import cv2
import numpy as np
import pytest

from endoprior.phantom import PhantomConfig, write_phantom
from endoprior.phantom.camera import AT_ORIGIN, CameraPose
from endoprior.phantom.config import Instruments
from endoprior.phantom.instrument_families import instruments_of
from endoprior.phantom.instrument_shapes import SHAFT, distance
from endoprior.phantom.instrument_tracing import pack, render_instruments
from endoprior.phantom.motion import ToolPose
from endoprior.phantom.raster import FAR
from endoprior.phantom.scene import SceneState, build_scene
from endoprior.phantom.views import render_view

SMALL = PhantomConfig(frames=48, width=96, height=80, seed=3)
FAMILIES = [name for name in get_args(Instruments) if name != "graspers"]
ACROSS = ToolPose(np.array([-80.0, 0.0, 60.0]), np.array([20.0, 0.0, 60.0]), 0.3, 0.0)
"""A tool in the image's plane, from the left."""
NEAR = ToolPose(np.array([72.0, 34.0, 20.0]), np.array([8.0, 6.0, 58.0]), 0.2, -0.5)
"""A tool from the right that points away from the camera, as in the phantom."""
DEFAULT_VIEW = [0.2440417, 0.07395053, 0.06650015, 0.18963233, 0.06541793, 0.05908938, 0.15120443, 43.639053]
"""Means of the frame in the middle before there were families: color of tissue and image, share and z of the tools."""
DEFAULT_TEXTURE = [0.38379377, 0.10104833, 0.089813064, 0.74997401, 0.85338533]
"""Means of color, wetness and openness before there were kinds."""
DEFAULT_HOVER = [19.927946414384465, 12.826196800453241, 23.343324658019583]


@pytest.fixture(scope="module")
def scene(all_vessels):
    """A small scene with a family's motion; tests exchange the tools."""
    return build_scene(replace(SMALL, instruments="blue"))


def seen(scene, family, phase=0.5, seed=0):
    """What the left camera sees of the scene with a family's tools."""
    scene = replace(scene, instruments=instruments_of(family, seed))
    return render_view(scene, SceneState.of(scene, phase), AT_ORIGIN)


def drawn(tool, pose=ACROSS, color=(0.4, 0.1, 0.1), size=(80, 96), z=90.0):
    """(color, depth) of one tool before a wall of one color, from the origin; focal length 80 px."""
    wall = np.broadcast_to(np.float32(color), (*size, 3)).copy()
    center = size[1] / 2, size[0] / 2
    far = np.full(size, z, np.float32)
    return render_instruments((pose,), (tool,), 0, wall, far, np.zeros(3, np.float32), 80.0, center)


# --- the default stays ----------------------------------------------------------------------------------------------


def test_the_default_has_the_tools_and_the_tissue_it_had(all_vessels):
    built = build_scene(replace(SMALL, frames=3))
    assert not built.instruments[0].parts and built.smoke is None and not built.cfg.has_kinds
    assert built.motion.hover[:3].tolist() == DEFAULT_HOVER
    texture = built.texture.reshape(-1, 7).mean(0, dtype=float)[[0, 1, 2, 5, 6]]
    assert texture == pytest.approx(DEFAULT_TEXTURE, rel=1e-5)
    view = render_view(built, SceneState.of(built, 0.5), AT_ORIGIN)
    means = *view.tissue.mean((0, 1)), *view.image.mean((0, 1)), view.tool_share.mean()
    found = [*means, view.tool_depth[view.tool_depth < FAR].mean()]
    assert found == pytest.approx(DEFAULT_VIEW, rel=1e-3)  # samples at rims depend on the CPU


# --- every family ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("family", FAMILIES)
def test_tools_are_in_view_and_masks_are_exact(scene, family):
    for phase in (0.02, 0.5):
        view = seen(scene, family, phase)
        share = view.tool_share
        assert 0.06 < (share > 0).mean() < 0.32
        assert np.array_equal(share > 0, view.tool_depth < FAR)
        assert (10 < view.tool_depth[share > 0]).all() and (view.tool_depth[share > 0] < 110).all()
        assert np.array_equal(view.image[share == 0], view.tissue[share == 0])
        assert np.isfinite(view.image).all() and (view.image > 0).all()
        inside = share == 1
        assert np.abs(view.image - view.tissue).max(-1)[inside].mean() > 0.03
    assert not np.array_equal(seen(scene, family, 0.02).tool_share, share), "the tools move"


@pytest.mark.parametrize("family", FAMILIES)
def test_both_tools_are_seen_and_differ_in_shape(family):
    first, second = instruments_of(family, 0)
    masks = [drawn(tool)[1] < FAR for tool in (first, second)]
    assert all(mask.sum() > 300 for mask in masks)
    assert (masks[0] ^ masks[1]).sum() > 40


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES)
def test_nothing_is_cut_off_by_the_bounds(family):
    for tool in instruments_of(family, 0):
        wide = replace(tool, bound_mm=40.0, ball_mm=40.0, clear_mm=390.0)
        for pose in (replace(ACROSS, opening=0.05, roll=0.4), replace(NEAR, opening=0.65), NEAR):
            depth, want = (drawn(each, pose, size=(320, 384))[1] for each in (tool, wide))
            # Rays that graze a surface stop 0.012 mm from it at another place when they start elsewhere.
            assert (np.abs(depth - want) > 0.2).sum() < 0.005 * (want < FAR).sum(), tool.name


def test_families_have_the_widths_and_ends_of_real_tools():
    tools = [tool for family in FAMILIES if family != "mixed" for tool in instruments_of(family, 0)]
    assert len({tool.name for tool in tools}) == len(tools) == 14
    widths = [next(part[5] for part in tool.parts if part[1] == SHAFT) for tool in tools]
    assert min(widths) < 2.3 and max(widths) > 5 and len(set(widths)) >= 6
    jawless = [tool.name for tool in tools if all(part[1] < 2 for part in tool.parts)]
    assert sorted(jawless) == ["hook electrode", "spatula electrode", "suction tube"]


def test_the_seed_changes_shade_and_mixed_pair():
    assert instruments_of("gold", 1) == instruments_of("gold", 1)
    assert instruments_of("gold", 1) != instruments_of("gold", 2)
    pairs = {tuple(tool.name for tool in instruments_of("mixed", seed)) for seed in range(8)}
    assert len(pairs) >= 6 and all(first != second for first, second in pairs)


# --- shape ----------------------------------------------------------------------------------------------------------


def test_suction_tube_closed_form():
    tool = instruments_of("steel", 0)[1]
    pose = replace(ACROSS, tip=np.array([20.0, 0.0, 60.0]))
    numbers = pack(pose, tool, 0, 0)
    wrist, back = numbers[:3].astype(float), numbers[3:6].astype(float)
    assert np.allclose(wrist, pose.tip) and np.allclose(back, [-1, 0, 0])
    parts = np.array(tool.parts, np.float32)

    def gap(along, radial):
        point = (wrist + along * back + radial * numbers[9:12]).astype(np.float32)
        return distance(*point, numbers, parts)[0]

    assert gap(30.0, 0.0) == pytest.approx(2.0, abs=1e-4)  # the bore's radius
    assert gap(30.0, 2.5) == pytest.approx(-0.5, abs=1e-4)  # in the middle of the wall
    assert gap(30.0, 7.0) == pytest.approx(4.0, abs=1e-4)
    assert gap(3.2, 2.5) > 0 > gap(5.0, 2.5)  # in the first side hole, and between two
    color, depth = drawn(tool, pose, size=(80, 96))
    y, x = np.nonzero(depth < FAR)
    points = np.stack([(x + 0.5 - 48) / 80, (y + 0.5 - 40) / 80, np.ones(len(x))], -1) * depth[y, x, None]
    radial = np.linalg.norm((points - wrist)[:, 1:], axis=-1)
    outside = radial > 2.1
    assert outside.mean() > 0.8 and np.allclose(radial[outside & (points[:, 0] < -5)], 3.0, atol=0.03)
    assert (color[depth < FAR] > 0).all() and (color[depth >= FAR] == 0).all()


def test_a_tapered_tube_and_a_bar_are_never_farther_than_they_say():
    # Sphere tracing needs it: between two points the distance changes by no more than the way between them.
    rng = np.random.default_rng(0)
    for family in ("black", "green", "blue", "white_plastic"):
        for tool in instruments_of(family, 0):
            numbers, parts = pack(ACROSS, tool, 0, 0), np.array(tool.parts, np.float32)
            points = (numbers[:3] + rng.uniform(-14, 14, (400, 3))).astype(np.float32)
            moved = (points + rng.normal(0, 0.4, points.shape)).astype(np.float32)
            before, after = (np.array([distance(*p, numbers, parts)[0] for p in each]) for each in (points, moved))
            assert (np.abs(before - after) <= 1.06 * np.linalg.norm(points - moved, axis=1) + 1e-4).all(), tool.name


def test_a_tool_at_rest_in_the_world_stays_when_the_camera_turns():
    turned = CameraPose(np.array([1.0, 2.0, 3.0]), cv2.Rodrigues(np.array([0.0, 0.0, np.pi / 2]))[0])
    tool = instruments_of("gray_blue", 0)[0]
    size, still = (96, 96), np.zeros(3, np.float32)
    wall, z = np.zeros((*size, 3), np.float32), np.full(size, 90, np.float32)
    there = [ToolPose(turned.rotation @ p + turned.center, turned.rotation @ q + turned.center, 0.3, 0.0)
             for p, q in ((ACROSS.pivot, ACROSS.tip),)]  # fmt: skip
    depth = [
        render_instruments((pose,), (tool,), 0, wall, z, still, 80.0, (48.0, 48.0), eye)[1] < FAR
        for pose, eye in ((ACROSS, AT_ORIGIN), (there[0], turned))
    ]
    # The wrist bends towards the line of sight of the first camera, so the jaws differ a little.
    assert (depth[0] ^ depth[1]).mean() < 0.02 and depth[0].mean() > 0.05


# --- color ----------------------------------------------------------------------------------------------------------


def shaft_color(family, which=0, wall=(0.4, 0.1, 0.1)):
    """(3,) mean linear color of a tool's shaft, more than 18 mm behind the wrist."""
    tool = instruments_of(family, 0)[which]
    color, depth = drawn(tool, color=wall)
    return color[:, :38][depth[:, :38] < FAR].mean(0)


def test_colors_are_those_of_the_names():
    red, green, blue = shaft_color("gray_blue")
    assert blue > 1.1 * red and max(red, green, blue) < 2 * min(red, green, blue)
    red, green, blue = shaft_color("gold")
    assert red > 1.2 * green > 1.2 * 1.5 * blue
    red, green, blue = shaft_color("green")
    assert green > 1.5 * max(red, blue)
    red, green, blue = shaft_color("blue")
    assert blue > 2 * max(red, green)
    white, gray, black = (shaft_color(name).mean() for name in ("white_plastic", "gray_blue", "black"))
    assert white > 2.5 * gray > 2.5 * 1.5 * black
    ivory = shaft_color("white_plastic", 1)
    assert ivory[0] > ivory[1] > 1.15 * ivory[2]


def test_steel_mirrors_the_tissue_and_plastic_hardly_does():
    change = {}
    for family in ("steel", "black", "gray_blue", "white_plastic"):
        reddish, greenish = (shaft_color(family, 0, wall) for wall in ((0.5, 0.1, 0.1), (0.1, 0.5, 0.1)))
        change[family] = reddish[0] - greenish[0]
    steel = change.pop("steel")
    assert steel > 0.05 and 0 < min(change.values()) and max(change.values()) < 0.25 * steel, (steel, change)


def test_mixed_tools_are_printed_and_worn():
    tool = instruments_of("mixed", 3)[0]
    shaft = tool.materials[0]
    assert shaft.rings[3] >= 2 and shaft.print_at[1] > 0 and shaft.wear > 0
    plain = replace(tool, materials=tuple(replace(m, rings=(0, 1, 1, 0), print_at=(0, 0)) for m in tool.materials))
    new = replace(plain, materials=tuple(replace(m, wear=0.0) for m in plain.materials))
    printed, bare, fresh = (drawn(each, size=(320, 384))[0].mean(-1) for each in (tool, plain, new))
    ink = np.abs(printed - bare) > 0.05
    assert 0.02 < ink.sum() / (printed > 0).sum() < 0.4
    assert (np.abs(bare - fresh) > 0.01).sum() > 0.02 * (printed > 0).sum()


# --- the written folder and errors ----------------------------------------------------------------------------------


def test_the_folder_says_what_it_shows(tmp_path):
    out = tmp_path / "sequence"
    write_phantom(out, replace(SMALL, frames=2, instruments="green", tissue="smoke", side_views=False))
    described = json.loads((out / "truth/scene.json").read_text())
    assert described == {
        "instruments": "green",
        "tools": ["clip applier", "hook electrode"],
        "tissue": "smoke",
        "smoke": [0.0, 0.0],
    }
    assert "seed 3, instruments green, tissue smoke)" in json.loads((out / "sequence.json").read_text())["note"]
    for index in range(2):
        mask = cv2.imread(str(out / f"masks/{index:06d}.png"), cv2.IMREAD_UNCHANGED) == 255
        depth = cv2.imread(str(out / f"depth/{index:06d}.png"), cv2.IMREAD_UNCHANGED) * 0.01
        z = np.load(out / f"truth/depth/{index:06d}.npy")
        near = (depth > 0) & (depth < z - 4)  # more than the depth's errors
        assert near.sum() > 0.4 * mask.sum() and not (near & ~mask).any()
