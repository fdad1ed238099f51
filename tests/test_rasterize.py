"""`endoprior.rasterize`: gsplat's names, shapes and return values on our backends, with gradients."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from render_scenes import agree, camera, splats

import endoprior
from endoprior import render
from endoprior.core.checks import InputError
from endoprior.render.constants import NEAR_Z
from endoprior.render.sh import C0

BACKENDS = ("reference", "numba")
FIELDS = ("means", "quats", "scales", "opacities", "colors")


def arguments(views, scene, dtype=torch.float32, **changes):
    """Our cameras and Gaussians as `rasterize` takes them; near plane as ours."""
    ks = [[[view.fx, 0, view.cx], [0, view.fy, view.cy], [0, 0, 1]] for view in views]
    values = {
        **{name: getattr(scene, name) for name in FIELDS[:-1]},
        "colors": scene.sh,
        "viewmats": torch.tensor(np.stack([view.world_to_camera for view in views])),
        "Ks": torch.tensor(ks),
    }
    found = {name: value.to(dtype) for name, value in values.items()}
    size = {"width": views[0].width, "height": views[0].height}
    return {**found, **size, "near_plane": NEAR_Z, "sh_degree": 3, **changes}


def flat(scene):
    """The Gaussians with one color each, and no change of it within."""
    return type(scene)(**{**scene.tensors, "color_slopes": None})


def dtype_of(backend):
    return torch.float64 if backend == "reference" else torch.float32


@pytest.mark.parametrize("backend", BACKENDS)
def test_it_renders_what_the_scene_renders(backend):
    views, scene = [camera(seed=0), camera(seed=1)], flat(splats(camera(seed=0)))
    background = torch.tensor([[0.1, 0.2, 0.3], [0.5, 0.4, 0.3]])
    given = arguments(views, scene, backgrounds=background, render_mode="RGB+D", backend=backend)
    images, alphas, info = endoprior.rasterize(**given)
    assert images.shape == (2, 37, 50, 4) and alphas.shape == (2, 37, 50, 1)
    for k, view in enumerate(views):
        want = render.load(backend)(scene, view, background=background[k])
        agree(images[k, ..., :3], want.color.double(), 2e-6, "color")
        agree(images[k, ..., 3], want.depth.double(), 2e-6, "depth")
        agree(alphas[k, ..., 0], want.alpha.double(), 2e-6, "alpha")
        assert torch.equal(info["radii"][k], want.radii[:, None].expand(-1, 2)) and (want.radii == 0).any()
        seen = want.radii > 0
        agree(info["means2d"][k, seen], want.means2d[seen].double(), 1e-6, "means2d")
    z = scene.means @ given["viewmats"][1, 2, :3] + given["viewmats"][1, 2, 3]
    seen = info["radii"][1, :, 0] > 0
    torch.testing.assert_close(info["depths"][1, seen], z[seen])
    assert (info["width"], info["height"], info["n_cameras"]) == (50, 37, 2)


@pytest.mark.parametrize("backend", BACKENDS)
def test_one_gaussian_in_closed_form(backend):
    """Round, on the axis: variance (f s / z)^2 + 0.3 px^2, in any unit of length."""
    focal, z, sigma, opacity = 40.0, 0.5, 0.02, 0.8
    images, alphas, _ = endoprior.rasterize(
        means=torch.tensor([[0.0, 0.0, z]]),
        quats=torch.tensor([[2.0, 0.0, 0.0, 0.0]]),
        scales=torch.full((1, 3), sigma),
        opacities=torch.tensor([opacity]),
        colors=torch.tensor([[0.9, -0.2, 0.0, 7.0]]),
        viewmats=torch.eye(4)[None],
        Ks=torch.tensor([[[focal, 0, 8.5], [0, focal, 6.5], [0, 0, 1]]]),
        width=17,
        height=13,
        render_mode="RGB+ED",
        backend=backend,
    )
    x, y = torch.arange(17) + 0.5 - 8.5, torch.arange(13) + 0.5 - 6.5
    squared = (x**2 + y[:, None] ** 2) / ((focal * sigma / z) ** 2 + 0.3)
    alpha = opacity * torch.exp(-0.5 * squared)
    alpha = torch.where(alpha >= 1 / 255, alpha, 0.0)
    torch.testing.assert_close(alphas[0, ..., 0], alpha, rtol=1e-5, atol=1e-6)
    for channel, color in enumerate((0.9, -0.2, 0.0, 7.0)):
        torch.testing.assert_close(images[0, ..., channel], color * alpha, rtol=1e-5, atol=1e-6)
    assert images.shape[-1] == 5
    torch.testing.assert_close(images[0, ..., 4][alpha > 0], torch.full_like(x, z)[0].expand(int((alpha > 0).sum())))
    assert not images[0, ..., 4][alpha == 0].any()


@pytest.mark.parametrize("unit", [1e-3, 0.05, 700.0])
def test_the_unit_of_length_does_not_matter(unit):
    view = camera()
    scene = flat(splats(view))
    want, _, _ = endoprior.rasterize(**arguments([view], scene, render_mode="RGB+D"))
    given = arguments([view], scene, render_mode="RGB+D", near_plane=NEAR_Z * unit)
    for name in ("means", "scales"):
        given[name] = given[name] * unit
    given["viewmats"] = given["viewmats"].clone()
    given["viewmats"][:, :3, 3] *= unit
    got, _, _ = endoprior.rasterize(**given)
    agree(got[..., :3], want[..., :3].double(), 1e-5, "color")
    agree(got[..., 3] / unit, want[..., 3].double(), 1e-5, "depth")


def test_planes_cull():
    view = camera()
    given = arguments([view], flat(splats(view)))
    _, _, info = endoprior.rasterize(**given)
    z, seen = info["depths"][0], info["radii"][0, :, 0] > 0
    _, _, found = endoprior.rasterize(**{**given, "near_plane": 40.0, "far_plane": 50.0})
    assert torch.equal(found["radii"][0, :, 0] > 0, seen & (z > 40) & (z <= 50))


def test_modes_are_parts_of_each_other():
    view = camera()
    given = arguments([view], flat(splats(view)))
    found = {mode: endoprior.rasterize(**given, render_mode=mode) for mode in ("RGB", "D", "ED", "RGB+D", "RGB+ED")}
    color, depth, alpha = found["RGB"][0], found["D"][0], found["D"][1]
    assert torch.equal(found["ED"][0], depth / alpha.clamp(min=1e-10)) and depth.shape == (1, 37, 50, 1)
    assert torch.equal(found["RGB+D"][0], torch.cat([color, depth], -1))
    assert torch.equal(found["RGB+ED"][0], torch.cat([color, found["ED"][0]], -1))


def test_colors_may_be_any_channels_and_differ_by_camera():
    views = [camera(), camera(seed=1)]
    scene = flat(splats(views[0]))
    generator = torch.Generator().manual_seed(0)
    channels = torch.randn(2, len(scene), 5, generator=generator)
    background = torch.randn(2, 5, generator=generator)
    given = arguments(views, scene, sh_degree=None, colors=channels, backgrounds=background)
    images, alphas, _ = endoprior.rasterize(**given)
    for k in range(2):
        for channel in range(5):
            one = {"colors": channels[k, :, channel, None], "backgrounds": background[:, channel, None]}
            single, _, _ = endoprior.rasterize(**{**given, **one})
            torch.testing.assert_close(images[k, ..., channel], single[k, ..., 0], rtol=0, atol=0)
    coefficients = (channels[..., None, :3].abs() - 0.5) / C0
    as_sh, _, _ = endoprior.rasterize(**{**given, "colors": coefficients, "sh_degree": 0, "backgrounds": None})
    plain, _, _ = endoprior.rasterize(**{**given, "colors": channels[..., :3].abs(), "backgrounds": None})
    torch.testing.assert_close(as_sh, plain, rtol=1e-4, atol=1e-5)
    assert alphas.max() > 0.9


def test_fewer_sh_than_there_are():
    view = camera()
    scene = flat(splats(view))
    got, _, _ = endoprior.rasterize(**arguments([view], scene, sh_degree=1))
    want, _, _ = endoprior.rasterize(**arguments([view], scene, colors=scene.sh[:, :4], sh_degree=1))
    assert torch.equal(got, want)


# Gradients.


def twisted(viewmats, twist):
    """Views that are moved by (C, 6) twists: a rotation vector and a translation."""
    zero = twist.new_zeros(len(twist))
    a, b, c = twist[:, :3].unbind(-1)
    skew = torch.stack([zero, -c, b, c, zero, -a, -b, a, zero], -1).view(-1, 3, 3)
    upper = torch.cat([skew, twist[:, 3:, None]], -1)
    return torch.matrix_exp(torch.cat([upper, twist.new_zeros(len(twist), 1, 4)], 1)) @ viewmats


@pytest.mark.parametrize("sh_degree", [None, 2])
def test_gradients_are_those_of_finite_differences(sh_degree):
    views = [camera(12, 9), camera(12, 9, seed=2)]
    views[1].world_to_camera[:3, 3] = views[0].world_to_camera[:3, 3]
    scene = flat(splats(views[0], num=5, degree=2, seed=3, widths=(2.0, 4.0)))
    given = arguments(views, scene, torch.float64, sh_degree=sh_degree, near_plane=0.1, backend="reference")
    given["opacities"] = given["opacities"].clamp(0.2, 0.7)
    given["viewmats"] = given["viewmats"][:1].expand(2, -1, -1)
    if sh_degree is None:
        given["colors"] = torch.rand(2, 5, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    background = torch.rand(2, 3 if sh_degree else 4, dtype=torch.float64)
    twist = torch.tensor([[0.02, 0.01, -0.03, 0.3, -0.2, 0.4], [0, 0, 0, 0, 0, 0]], dtype=torch.float64)
    inputs = [given.pop(name).clone().requires_grad_() for name in FIELDS]
    inputs += [background.requires_grad_(), twist.requires_grad_()]
    viewmats = given.pop("viewmats")

    def images(*values):
        named = dict(zip(FIELDS, values[:5], strict=True))
        named |= {"backgrounds": values[5], "viewmats": twisted(viewmats, values[6])}
        color, alpha, _ = endoprior.rasterize(**named, **given, render_mode="RGB+D")
        return color, alpha

    # What lies at 1/255 of a footprint jumps; few pixels do for these inputs and this step.
    assert torch.autograd.gradcheck(images, inputs, eps=1e-7, atol=1e-4, rtol=1e-3, fast_mode=True)


@pytest.mark.parametrize("moves", [False, True])
@pytest.mark.parametrize("backend", BACKENDS[1:])
def test_gradients_agree_with_the_reference(backend, moves):
    views = [camera(seed=0), camera(seed=1)]
    scene = flat(splats(views[0]))
    found = {}
    for name in ("reference", backend):
        given = arguments(views, scene, dtype_of(name), near_plane=0.05, backend=name, render_mode="RGB+ED")
        leaves = {key: given[key].clone().requires_grad_() for key in FIELDS}
        leaves["backgrounds"] = torch.full((2, 3), 0.3, dtype=dtype_of(name), requires_grad=True)
        twist = torch.zeros(2, 6, dtype=dtype_of(name), requires_grad=True)
        if moves:
            given["viewmats"] = twisted(given["viewmats"], twist)
        images, alphas, info = endoprior.rasterize(**{**given, **leaves})
        info["means2d"].retain_grad()
        weights = torch.randn(images.shape, generator=torch.Generator().manual_seed(0)).to(images.dtype)
        weights[..., 3] *= alphas.detach()[..., 0]  # depth divided by next to no alpha has any gradient
        ((weights * images).sum() + alphas.square().sum()).backward()
        grads = {key: value.grad for key, value in leaves.items()} | {"means2d": info["means2d"].grad}
        found[name] = images.detach(), grads | ({"twist": twist.grad} if moves else {})
    agree(found[backend][0], found["reference"][0], 1e-4, "images")
    for key, value in found["reference"][1].items():
        gap = (found[backend][1][key] - value).norm() / value.norm()
        assert gap < 1e-3 and value.abs().max() > 0, f"{key}: {gap:.1e}"


def test_a_camera_that_learns_sees_the_same():
    views = [camera(seed=seed) for seed in range(4)]
    scene = flat(splats(views[0]))
    given = arguments(views, scene, torch.float64, backend="reference", render_mode="RGB+D")
    want, _, _ = endoprior.rasterize(**given)
    got, _, _ = endoprior.rasterize(**{**given, "viewmats": given["viewmats"].requires_grad_()})
    torch.testing.assert_close(got, want, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1)])
def test_a_learning_camera_may_be_turned_around(axis):
    """Half turns, where a quaternion's real part is 0."""
    view = camera(seed=None)
    scene = flat(splats(view))
    x, y, z = np.array(axis) / math.sqrt(sum(axis))
    half_turn = 2 * np.outer((x, y, z), (x, y, z)) - np.eye(3)
    view.world_to_camera[:3, :3] = half_turn
    scene = type(scene)(**{**scene.tensors, "means": scene.means @ torch.tensor(half_turn).float()})
    given = arguments([view], scene, torch.float64, backend="reference")
    want, alphas, _ = endoprior.rasterize(**given)
    got, _, _ = endoprior.rasterize(**{**given, "viewmats": given["viewmats"].requires_grad_()})
    torch.testing.assert_close(got, want, rtol=1e-9, atol=1e-9)
    assert alphas.max() > 0.5


def test_the_example_of_the_page_runs(capsys):
    page = (Path(__file__).parents[1] / "docs" / "rasterize.md").read_text(encoding="utf-8")
    exec(re.search(r"```python\n(.*?)```", page, re.DOTALL)[1], {})
    assert "torch.Size([1, 120, 160, 4])" in capsys.readouterr().out


# What is not there.


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"camera_model": "fisheye"}, "camera_model: expected 'pinhole', as nothing else is supported, got 'fisheye'."),
        ({"packed": True}, "packed: expected False"),
        ({"eps2d": 0.1}, "eps2d: expected 0.3"),
        ({"covars": torch.zeros(1)}, "covars: expected None, as nothing else is supported, got a tensor. Fix: Leave"),
        ({"radial_coeffs": np.zeros(4)}, "radial_coeffs: expected None, as nothing else is supported, got an array."),
        ({"render_mod": "RGB"}, "Did you mean `render_mode`?"),
        ({"render_mode": "RGBD"}, "render_mode: expected one of RGB, D, ED, RGB+D, RGB+ED, got 'RGBD'"),
        ({"backend": "gsplat"}, "backend: expected one of reference, numba, triton, got 'gsplat'"),
        ({"near_plane": 0.0}, "near_plane, far_plane: expected 0 < near_plane < far_plane, got 0.0 and"),
        ({"viewmats": torch.diag(torch.tensor([2.0, 2, 2, 1]))[None]}, "viewmats[0]: expected a rotation and a"),
        ({"Ks": torch.tensor([[[9.0, 1, 4], [0, 9, 4], [0, 0, 1]]])}, "Ks[0]: expected [[fx, 0, cx], [0, fy, cy]"),
    ],
)
def test_what_is_not_supported_is_said_in_one_line(changes, says):
    view = camera()
    with pytest.raises(InputError) as raised:
        endoprior.rasterize(**{**arguments([view], flat(splats(view))), **changes})
    assert says in str(raised.value) and "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"quats": torch.zeros(60, 3)}, "quats: expected shape (60, 4), got (60, 3). Fix: Pass w, x, y, z of each G"),
        ({"opacities": torch.ones(60, 1)}, "opacities: expected shape (60,), got (60, 1). Fix: `opacities[..., 0]`."),
        ({"viewmats": torch.eye(4)}, "viewmats: expected shape (C, 4, 4), got (4, 4). Fix: `viewmats[None]` for one"),
        ({"Ks": torch.eye(3)}, "Ks: expected shape (1, 3, 3), got (3, 3). Fix: `Ks[None]` for one camera."),
        ({"colors": torch.zeros(2, 60, 16, 3)}, "colors: expected shape (1, 60, K, 3), got (2, 60, 16, 3). Fix: "),
        ({"colors": torch.zeros(59, 16, 3)}, "colors: expected shape (60, K, 3), got (59, 16, 3). Fix: Pass one ro"),
        ({"colors": torch.zeros(60, 7, 3)}, "colors: expected 1, 4, 9 or 16 coefficients per channel, got 7. Fix: "),
        ({"sh_degree": None}, "colors: expected shape (1, 60, D), got (60, 16, 3). Fix: Pass sh_degree=3 for coeff"),
        ({"colors": torch.zeros(60, 3)}, "colors: expected shape (60, K, 3), got (60, 3). Fix: Leave out sh_degree"),
        ({"sh_degree": 4}, "sh_degree: expected a whole number from 0 to 3, the degree of colors, got 4. Fix: Pass"),
        ({"sh_degree": -1}, "sh_degree: expected a whole number from 0 to 3"),
        ({"backgrounds": torch.zeros(1, 4)}, "backgrounds: expected shape (1, 3), got (1, 4). Fix: Pass one color of"),
        ({"backgrounds": torch.zeros(3)}, "backgrounds: expected shape (1, 3), got (3,). Fix: `backgrounds[None]` for"),
        ({"scales": torch.ones(60, 3).double()}, "scales: expected torch.float32, as means has, got torch.float64. Fi"),
        ({"colors": torch.zeros(60, 16, 3).half()}, "colors: expected torch.float32, as means has, got torch.float16"),
        ({"means": torch.zeros(60, 3).double(), "backend": None}, "got torch.float64. Fix: `means.float()`."),
        ({"quats": torch.ones(60, 4, device="meta")}, "quats: expected a tensor on cpu, as means, got meta. Fix: `"),
        ({"means": np.zeros((60, 3))}, "means: expected a torch.Tensor, got a NumPy array. Fix: `torch.from_numpy(mea"),
        ({"Ks": [[1.0]]}, "Ks: expected a torch.Tensor, got list. Fix: `torch.tensor(Ks)`."),
        ({"viewmats": None}, "viewmats: expected a torch.Tensor, got NoneType. Fix: Pass one 4 x 4 matrix of each"),
        ({"width": 50.0}, "width: expected a whole number of px above 0, got 50.0. Fix: `int(width)`."),
        ({"height": 0}, "height: expected a whole number of px above 0, got 0. Fix: Pass the size of the image."),
    ],
)
def test_what_does_not_fit_is_said_in_one_line(changes, says):
    view = camera()
    with pytest.raises(InputError) as raised:
        endoprior.rasterize(**{**arguments([view], flat(splats(view)), backend="reference"), **changes})
    assert says in str(raised.value) and "\n" not in str(raised.value)


def test_one_matrix_or_color_for_several_cameras_is_named():
    views = [camera(seed=0), camera(seed=1)]
    for name, one in (("Ks", torch.eye(3)), ("backgrounds", torch.zeros(3))):
        with pytest.raises(InputError, match=rf"Fix: `{name}\.expand\(2, .*\)` for the same in all cameras\.$"):
            endoprior.rasterize(**{**arguments(views, flat(splats(views[0]))), name: one})


def test_a_size_may_be_any_whole_number():
    view = camera()
    given = arguments([view], flat(splats(view)), backend="reference")
    images, _, _ = endoprior.rasterize(**{**given, "width": np.int64(view.width)})
    assert images.shape == (1, view.height, view.width, 3)


def test_options_that_change_nothing_are_taken():
    view = camera()
    given = arguments([view], flat(splats(view)))
    options = {"tile_size": 8, "channel_chunk": 4, "packed": False, "rasterize_mode": "classic", "radius_clip": 0}
    assert torch.equal(endoprior.rasterize(**given, **options)[0], endoprior.rasterize(**given)[0])


def test_no_gaussians_show_the_background():
    view = camera()
    scene = splats(view, num=0)
    images, alphas, _ = endoprior.rasterize(**arguments([view], flat(scene), backgrounds=torch.full((1, 3), 0.5)))
    assert (images == 0.5).all() and not alphas.any()


def test_gsplat_renders_the_same():
    gsplat = pytest.importorskip("gsplat")
    if not torch.cuda.is_available():
        pytest.skip("no GPU")
    view = camera()
    given = arguments([view], flat(splats(view)), render_mode="RGB+ED")
    given["opacities"] = given["opacities"].clamp(max=0.98)
    want = gsplat.rasterization(
        **{name: value.cuda() if isinstance(value, torch.Tensor) else value for name, value in given.items()}
    )
    got = endoprior.rasterize(**given)
    torch.testing.assert_close(got[0], want[0].cpu(), rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(got[1], want[1].cpu(), rtol=1e-3, atol=1e-3)
