"""Training on a device, without one: nobody waits in the loop, and what goes wrong there is noticed late but in time.

`definitions_only` runs on the CPU what runs on a device. Tensors on "meta" have no values: whatever asks for one fails,
as it would have to wait on a device.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from test_divergence import poison, state_of
from test_train import tiny_config

from endoprior.compute.compiled import definitions_only
from endoprior.core.types import RenderOutput
from endoprior.data import load_sequence
from endoprior.evaluation import metrics
from endoprior.model.basis import RankOneGradient
from endoprior.model.scene import load_scene
from endoprior.runs.training_run import train
from endoprior.training import adam_kernels, inspector, temporal
from endoprior.training.adam import AdamState
from endoprior.training.divergence import Diverged
from endoprior.training.frames import TrainingFrames
from endoprior.training.inspector import Inspector
from endoprior.training.recorded import Recorder
from endoprior.training.state import Stage
from endoprior.training.step import Work, on_tissue
from endoprior.training.trainer import Trainer

KINDS = ("basis", "hexplane")
NAN = float("nan")


@pytest.fixture
def on_definitions():
    with definitions_only():
        yield


def quiet(cfg):
    """Without density events, which must look at the device."""
    return replace(cfg, density=replace(cfg.density, start_iteration=10**6))


def picture_without_values(splats, camera, *, background, depth_grad_to_means=True):
    """A rasterizer that only has the right shapes, and hangs on all its inputs."""
    means2d = splats.means[:, :2] * 1.0
    tied = means2d.sum() + sum(getattr(splats, name).sum() for name in ("means", "quats", "scales", "opacities", "sh"))
    color = background.expand(camera.height, camera.width, 3) + tied
    flat = tied.expand(camera.height, camera.width).clone()
    radii = torch.empty(len(splats), dtype=torch.int32, device=background.device)
    return RenderOutput(color, flat, flat.clone(), means2d, radii)


def off_the_host(trainer, monkeypatch):
    """Move a started trainer to where no value can be read."""
    device = torch.device("meta")
    monkeypatch.setattr(adam_kernels, "adam", lambda *args, **kwargs: None)  # has no kernel there
    trainer.device, trainer.frames = device, TrainingFrames(trainer.sequence, trainer.cfg.prior, device)
    trainer._inspector = Inspector(device, waits=False)
    work = Work(trainer.cfg, picture_without_values, torch.zeros(3, device=device), trainer._inspector)
    trainer._work = Recorder(work, device, None)
    state = trainer.state
    trainer._enter(state.stage, state.gaussians.to(device), state.field and state.field.to(device))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("both", [False, True])
def test_no_iteration_waits_for_the_device(tiny_sequence, kind, both, monkeypatch):
    cfg = quiet(tiny_config(kind, coarse=3, fine=40))
    ends = {"gradient": "both", "valid_at_both": True} if both else {"max_points": 64}
    cfg = replace(cfg, temporal=replace(cfg.temporal, **ends))
    trainer = Trainer(load_sequence(tiny_sequence), cfg)
    trainer.start()
    trainer.state.stage = Stage.FINE
    off_the_host(trainer, monkeypatch)
    reports = [trainer.step() for _ in range(inspector.LOOK_EVERY - 1)]
    assert any("distance" in report.losses.names for report in reports)
    assert reports[-1].iteration == inspector.LOOK_EVERY - 1
    with pytest.raises((NotImplementedError, RuntimeError)):  # looking is waiting
        trainer.settle()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["means", "opacity_logits"])
def test_late_news_of_a_bad_gradient_finds_the_state_before_it(tiny_sequence, kind, name, on_definitions):
    trainer = Trainer(load_sequence(tiny_sequence), quiet(tiny_config(kind, coarse=0, fine=200)))
    trainer.start()
    for _ in range(8):
        trainer.step()
    trainer.settle()
    before = state_of(trainer)
    poison(trainer, name, NAN)
    with pytest.raises(Diverged, match=f"nan in the gradient of {name}"):
        for _ in range(inspector.LOOK_EVERY):
            trainer.step()
    after = state_of(trainer)
    assert trainer.state.iteration == 8
    assert all(torch.equal(before[key], after[key]) for key in before)


def test_a_run_folder_keeps_the_scene_before_late_news(tiny_sequence, tmp_path, on_definitions):
    def spoil(report, trainer):
        if report.iteration == 9:
            poison(trainer, "quats", NAN)

    cfg = quiet(tiny_config("basis", coarse=0, fine=60))
    with pytest.raises(Diverged, match=r"fine iteration 10: .*last_good"):
        train(load_sequence(tiny_sequence), cfg, tmp_path / "run", on_step=spoil)
    scene = load_scene(tmp_path / "run" / "last_good.safetensors")
    assert all(bool(value.isfinite().all()) for value in scene.gaussians.tensors.values())


def test_the_last_iteration_and_a_checkpoint_are_not_taken_on_trust(tiny_sequence, on_definitions):
    trainer = Trainer(load_sequence(tiny_sequence), quiet(tiny_config("basis", coarse=0, fine=3)))
    trainer.start()
    poison(trainer, "means", NAN)
    trainer.step()
    with pytest.raises(Diverged):
        trainer.settle()
    assert trainer.state.iteration == 0
    with pytest.raises(Diverged):
        for _ in range(3):
            trainer.step()
    assert trainer.state.iteration == 0


@pytest.mark.parametrize("frozen", [0.0, 1.0])
def test_a_frozen_step_changes_nothing(frozen):
    generator = torch.Generator().manual_seed(0)
    plain, motion = (torch.randn(5, 4, 3, generator=generator).requires_grad_() for _ in range(2))
    states, flag = [AdamState(plain), AdamState(motion, 4)], torch.tensor(frozen)
    with definitions_only():
        for step in range(3):
            now, hold = (flag, NAN) if step == 1 and frozen else (torch.tensor(0.0), 1.0)
            before = [t.detach().clone() for s in states for t in (s.first, s.second, s.steps)]
            before += [plain.detach().clone(), motion.detach().clone()]
            plain.grad = torch.full_like(plain, hold)
            states[0].update(plain, 1e-2, 1e-15, now)
            gradient = RankOneGradient(np.array([0, 0.5, 1, 0], np.float32), torch.full((5, 3), hold))
            states[1].update_bases(motion, [gradient], np.full(3, 1e-2), 1e-15, now)
            after = [t.detach() for s in states for t in (s.first, s.second, s.steps)] + [plain, motion]
            same = [torch.equal(a, b) for a, b in zip(before, after, strict=True)]
            assert all(same) if now else not any(same)


@pytest.mark.parametrize("kernels", [True, False])
def test_every_update_is_the_same_adam(kernels):
    """Kernel and device form against the definition: the fused step of torch, and the band of a basis."""
    rng, rates = np.random.default_rng(0), np.array([1e-2, 3e-2, 1e-3])
    motion = torch.from_numpy(rng.normal(size=(6, 4, 3)).astype(np.float32)).requires_grad_()
    want, first, second = motion.detach().clone(), torch.zeros(6, 4, 3), torch.zeros(6, 4, 3)
    plain, plain_want = motion.detach().clone().requires_grad_(), motion.detach().clone()
    plain_moments = torch.zeros(6, 4, 3), torch.zeros(6, 4, 3)
    state, plain_state = AdamState(motion, 4), AdamState(plain)
    for step in range(1, 6):
        weights, v_offsets = rng.random(4).astype(np.float32), torch.randn(6, 3)
        grad = torch.from_numpy(weights)[:, None] * v_offsets[:, None]
        corrected = torch.from_numpy(rates).float() / (1 - 0.9**step), 1 / np.sqrt(1 - 0.999**step)
        adam_kernels.adam_definition(want, grad, first, second, *corrected, 1e-15)
        adam_kernels.adam_definition(plain_want, grad, *plain_moments, 1e-2 / (1 - 0.9**step), corrected[1], 1e-15)
        plain.grad = grad
        with definitions_only() if not kernels else torch.enable_grad():
            state.update_bases(motion, [RankOneGradient(weights, v_offsets)], rates, 1e-15)
            plain_state.update(plain, 1e-2, 1e-15)
    torch.testing.assert_close(motion.detach(), want, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(plain.detach(), plain_want, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("share", [0.0, 0.05, 0.5, 1.0])
@pytest.mark.parametrize("relaxed", [False, True])
def test_the_same_gaussians_are_chosen(share, relaxed, on_definitions):
    rng = np.random.default_rng(3)
    score, eligible = rng.random(900).astype(np.float32), rng.random(900) < share
    base = tiny_config("basis").temporal
    cfg = replace(base, max_points=100, min_points=0, num_neighbors=3, adaptive_motion_weight=relaxed)
    want, want_weights = temporal.choose(score, eligible, cfg)
    index, weights = temporal.choose_on(torch.from_numpy(score), torch.from_numpy(eligible), cfg)
    assert index.shape == weights.shape == (100,)
    taken = weights > 0
    assert index[taken].tolist() == want.tolist() and (len(want) > 0) == (share > 0)
    np.testing.assert_allclose(weights[taken], want_weights, rtol=1e-4)  # float32 against float64


def test_who_takes_no_part_changes_no_term(on_definitions):
    generator = torch.Generator().manual_seed(1)
    before = torch.randn(120, 3, generator=generator) * 20
    now = before + torch.randn(120, 3, generator=generator)
    weights = torch.rand(120, generator=generator)
    cfg = tiny_config("basis").temporal
    want = temporal.local_consistency(now[:90], before[:90], weights[:90], cfg)
    strangers = torch.cat([weights[:90], torch.zeros(30)])
    torch.testing.assert_close(torch.stack(temporal.local_consistency(now, before, strangers, cfg)), torch.stack(want))
    few = torch.cat([weights[: cfg.num_neighbors], torch.zeros(112)])
    now.requires_grad_()
    terms = temporal.local_consistency(now, before, few, cfg)
    sum(terms).backward()
    assert float(sum(terms).detach()) == 0 and not now.grad.any()


def test_points_are_on_tissue_by_the_definition_too(tiny_sequence):
    trainer = Trainer(load_sequence(tiny_sequence), tiny_config("basis"))
    trainer.start()
    points, frame = trainer.state.gaussians["means"].detach() * 1.1, trainer.frames.frame(0)
    want = on_tissue(points, frame)
    with definitions_only():
        assert torch.equal(on_tissue(points, frame), want)
    assert want.any() and not want.all()


def test_fp16_planes_change_no_image(tiny_sequence, tmp_path):
    """Within 0.02 dB of what full precision scores, as the tissue is drawn after training; and they are not saved."""
    sequence = load_sequence(tiny_sequence)
    cfg = quiet(tiny_config("hexplane", coarse=20, fine=80))
    scene = train(sequence, cfg)
    with definitions_only():
        halved = scene.to("cpu", fp16_planes=True)
        scores = []
        for each in (scene, halved):
            pictures = [(each.render(f.time, f.camera).color.numpy(), f.rgb) for f in sequence.frames("video")]
            scores.append([metrics.psnr_tissue(image, target, target[..., 0] >= 0) for image, target in pictures])
    assert not np.array_equal(*scores)
    np.testing.assert_allclose(*scores, rtol=0, atol=0.02)
    assert halved.field.grid.values.dtype == torch.float16 and not halved.field.grid.grads.numel()
    with pytest.raises(ValueError, match="fp16 planes"):
        halved.save(tmp_path / "scene.safetensors")
