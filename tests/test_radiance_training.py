"""Training of radiance fields: rays drawn from frames, resuming, divergence, the file of a scene, its scores."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from state_files import StateFile

from endoprior.cli.paths import open_gaussians
from endoprior.core.checks import InputError
from endoprior.core.config import Config
from endoprior.core.types import Frame
from endoprior.data import FrameSequence, load_sequence
from endoprior.evaluation import context
from endoprior.evaluation.scorers import model
from endoprior.evaluation.scoring import evaluate
from endoprior.export import export
from endoprior.model.presets import preset
from endoprior.model.scene_file import load_scene
from endoprior.runs.remote import train_here, trainings
from endoprior.runs.train import start_run, train
from endoprior.system.arrays_file import load_arrays, save_arrays
from endoprior.training import divergence
from endoprior.training.divergence import Diverged
from endoprior.training.trainer import Stage
from endoprior_radiance import presets as presets_radiance
from endoprior_radiance.endonerf import EndoNeRF, depth_spread
from endoprior_radiance.endosurf import EndoSurf, enclosing_sphere, without_outliers
from endoprior_radiance.rays import RayFrames, measured
from endoprior_radiance.scene import RadianceScene
from endoprior_radiance.trainer import RadianceTrainer

FIELDS = {"endonerf": EndoNeRF, "endosurf": EndoSurf}
NAMES = tuple(FIELDS)


def tiny(name: str, iterations: int = 6, **radiance: int) -> Config:
    """A config of few rays and samples, in which everything happens."""
    cfg = getattr(presets_radiance, name)()
    small = replace(cfg.radiance, **{"rays": 6, "even_samples": 5, "more_samples": 5} | radiance)
    return replace(cfg, radiance=small, schedule=replace(cfg.schedule, fine_iterations=iterations))


@pytest.fixture
def sequence(make_tiny_sequence: Callable[..., Path]) -> FrameSequence:
    return load_sequence(make_tiny_sequence(num_frames=6, width=10, height=8), tiny("endonerf").data)


def changed(sequence: FrameSequence, change: Callable[[Frame], Frame]) -> FrameSequence:
    """The sequence with other frames."""
    cameras = [sequence.camera(i) for i in range(len(sequence))]
    return FrameSequence(sequence.path, cameras, lambda index: change(sequence.frame(index)))


def started(sequence: FrameSequence, name: str, cfg: Config | None = None) -> RadianceTrainer:
    trainer = RadianceTrainer(sequence, cfg or tiny(name), FIELDS[name])
    trainer.start()
    return trainer


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


@pytest.mark.parametrize("name", ["endonerf", pytest.param("endosurf", marks=pytest.mark.slow)])
def test_a_resumed_run_is_bit_identical(name: str, sequence: FrameSequence, tmp_path: Path):
    cfg = tiny(name, 4, refine_every=3 if name == "endonerf" else 0)
    whole = started(sequence, name, cfg)
    whole.run([])
    assert whole.finished and whole.progress() == (4, 4)
    first = started(sequence, name, cfg)
    for _ in range(2):
        first.step()
    save_arrays(tmp_path / "state", first.state.arrays(), {}, "test-1")
    second = RadianceTrainer(sequence, cfg, FIELDS[name])
    arrays, _ = load_arrays(tmp_path / "state", {"test-1": lambda about: second.schema()}, "")
    second.restore(Stage.FINE, 2, arrays)
    second.run([])
    assert same(whole.state.arrays(), second.state.arrays())
    assert same(dict(whole.scene().field.state_dict()), dict(second.scene().field.state_dict()))


@pytest.mark.parametrize("name", ["endonerf", pytest.param("endosurf", marks=pytest.mark.slow)])
def test_training_lowers_the_loss(name: str, sequence: FrameSequence, monkeypatch: pytest.MonkeyPatch):
    trainer, found = started(sequence, name, tiny(name, 12)), []
    batch = trainer.batch(np.random.default_rng(0))
    monkeypatch.setattr(trainer, "batch", lambda rng: batch)
    trainer.run([lambda report, _: found.append(sum(report.terms.values()))])
    assert np.isfinite(found).all()
    assert np.mean(found[-3:]) < 0.7 * np.mean(found[:3])


def test_seed_decides(sequence: FrameSequence):
    a, b, c = (started(sequence, "endonerf", replace(tiny("endonerf", 2), seed=seed)) for seed in (0, 0, 1))
    for trainer in (a, b, c):
        trainer.run([])
    assert same(a.state.arrays(), b.state.arrays())
    assert not same(a.state.arrays(), c.state.arrays())


@pytest.mark.parametrize("name", NAMES)
def test_divergence_leaves_the_state_alone(name: str, sequence: FrameSequence, monkeypatch: pytest.MonkeyPatch):
    trainer = started(sequence, name)
    trainer.step()
    before = {key: value.clone() for key, value in trainer.state.arrays().items()}
    found = trainer.state.field.losses

    def poisoned(*args: object) -> dict[str, torch.Tensor]:
        terms = found(*args)
        return terms | {"color": terms["color"] * torch.nan}

    monkeypatch.setattr(trainer.state.field, "losses", poisoned)
    with pytest.raises(Diverged, match="color nan"):
        trainer.step()
    assert trainer.state.iteration == 1
    assert same(before, trainer.state.arrays())


@pytest.mark.parametrize("name", NAMES)
def test_rays_that_stay_black_end_the_run(name: str, sequence: FrameSequence, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(divergence, "WINDOW", 3)
    monkeypatch.setattr(divergence, "PARTS", 1)
    trainer = started(sequence, name)
    color = trainer.state.field.canonical.color if name == "endonerf" else trainer.state.field.color.layers[-1]
    for _ in range(2):
        with torch.no_grad():
            color.bias.fill_(-1e3)
        trainer.step()
    with torch.no_grad():
        color.bias.fill_(-1e3)
    with pytest.raises(Diverged, match=r"background alone .* raise --radiance\.rays"):
        trainer.step()
    assert trainer.state.iteration == 2


@pytest.mark.parametrize("name", NAMES)
def test_missing_and_poisoned_depth_is_never_used(name: str, sequence: FrameSequence):
    def spoil(frame: Frame) -> Frame:
        depth = frame.depth.copy()
        depth[::2], depth[1::4] = np.nan, 0
        return replace(frame, depth=depth, depth_valid=np.ones_like(frame.depth_valid))

    trainer = started(changed(sequence, spoil), name)
    report = trainer.step()
    assert all(np.isfinite(value) for value in report.terms.values())
    assert all(bool(value.isfinite().all()) for value in trainer.state.arrays().values() if value.is_floating_point())


@pytest.mark.parametrize("name", NAMES)
def test_frames_without_tissue_are_never_drawn(name: str, sequence: FrameSequence):
    def hide(frame: Frame) -> Frame:
        return replace(frame, tissue_mask=frame.tissue_mask & (frame.index == 2))

    frames = RayFrames(changed(sequence, hide), only_measured=FIELDS[name].only_measured)
    assert [frames.indices[k] for k in frames.usable] == [2]
    started(changed(sequence, hide), name).step()
    nowhere = changed(sequence, lambda frame: replace(frame, tissue_mask=np.zeros_like(frame.tissue_mask)))
    with pytest.raises(InputError, match="expected tissue"):
        started(nowhere, name).step()


def test_pixels_are_drawn_as_often_as_said(sequence: FrameSequence):
    frames = RayFrames(sequence, only_measured=False)
    pixels = frames.draw(0, 400_000, np.random.default_rng(0))
    mask = frames.frame(0).tissue_mask.ravel()
    hidden = sum((~sequence.frame(i).tissue_mask).astype(float) for i in sequence.indices("train")).ravel()
    wanted = mask * (1 + hidden / np.linalg.norm(hidden))
    np.testing.assert_allclose(
        np.bincount(pixels, minlength=mask.size) / len(pixels), wanted / wanted.sum(), atol=9e-4
    )  # 5 deviations
    assert mask[pixels].all() and wanted.max() > 1.05
    surface = RayFrames(sequence, only_measured=True)
    assert measured(surface.frame(0)).ravel()[surface.draw(0, 1000, np.random.default_rng(0))].all()


def test_only_training_frames_are_read(sequence: FrameSequence):
    for name in NAMES:
        started(sequence.training_view(), name, tiny(name, 2)).run([])


def test_sizes_of_the_sequence(sequence: FrameSequence):
    frames = RayFrames(sequence, only_measured=True)
    depths = np.concatenate([frames.depth(k).ravel() for k in range(len(frames))])
    assert depth_spread(frames) == pytest.approx(np.percentile(depths, 99.9) - np.percentile(depths, 3))
    center, radius = enclosing_sphere(frames)
    assert 40 < center[2] < 80 and 5 < radius < 60
    cloud = np.random.default_rng(0).random((200, 3))
    far = np.concatenate([cloud, [[50.0, 0, 0]]])
    np.testing.assert_array_equal(without_outliers(far), cloud)
    assert len(without_outliers(cloud[:3])) == 3


@pytest.mark.parametrize("name", NAMES)
def test_scene_from_its_file_renders_alike(
    name: str, sequence: FrameSequence, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    trainer = started(sequence, name)
    trainer.step()
    scene = trainer.scene()
    scene.save(tmp_path / "scene.safetensors")
    loaded = load_scene(tmp_path / "scene.safetensors")
    a, b = scene.render(0.4), loaded.render(0.4)
    assert a.color.shape == (8, 10, 3) and a.depth.shape == a.alpha.shape == (8, 10)
    assert torch.equal(a.color, b.color) and torch.equal(a.depth, b.depth) and torch.equal(a.alpha, b.alpha)
    assert float(a.color.min()) >= 0 and float(a.color.max()) <= 1 and not a.color.requires_grad
    monkeypatch.setattr("endoprior_radiance.scene.SAMPLES_AT_ONCE", {"cpu": 100})  # 8 rays at a time
    torch.testing.assert_close(loaded.render(0.4).color, a.color)
    assert loaded.to("cpu") is loaded and loaded.frames_per_second == 15
    with pytest.raises(ValueError, match="time must be"):
        loaded.render(1.5)


def test_depth_of_a_scene_is_z(sequence: FrameSequence):
    """A field that is a wall at the center: z is that depth in every pixel, also off axis."""
    trainer = started(sequence, "endosurf", tiny("endosurf", even_samples=32, more_samples=32))
    field, camera = trainer.state.field, sequence.camera(0)
    field.surface.forward = lambda points: (-points[:, 2], torch.zeros(len(points), 256))
    field.deformation.forward = lambda points, time: torch.zeros_like(points)
    field.deformation.with_change = lambda points, time, along: (torch.zeros_like(points), torch.zeros_like(points))
    with torch.no_grad():
        field.sharpness.fill_(0.6)
    field.anneal.fill_(1.0)
    view = trainer.scene().render(0.0, camera)
    depth = (view.depth / view.alpha)[view.alpha > 0.5]
    assert len(depth) > 60
    np.testing.assert_allclose(depth, float(field.center_mm[2]), rtol=0.01)


@pytest.mark.parametrize(
    ("edit", "problem"),
    [
        (lambda file: file.arrays["field.radius_mm"].fill(0), "a positive number in radius_mm"),
        (lambda file: file.arrays["field.color.layers.0.bias"].fill(np.nan), "finite numbers"),
        (lambda file: file.arrays.pop("field.sharpness"), "an array field.sharpness"),
        (lambda file: file.about.update(width=0), "width"),
        (
            lambda file: file.arrays.update({"camera.world_to_camera": 0 * file.arrays["camera.world_to_camera"]}),
            "rigid transforms",
        ),
    ],
)
def test_files_that_no_training_writes_are_rejected(
    edit: Callable[[StateFile], None], problem: str, sequence: FrameSequence, tmp_path: Path
):
    path = tmp_path / "scene.safetensors"
    started(sequence, "endosurf").scene().save(path)
    file = StateFile.read(path)
    edit(file)
    file.write(path)
    with pytest.raises(InputError, match=problem) as caught:
        load_scene(path)
    assert str(caught.value).startswith(f"{path}:") and "\n" not in str(caught.value)


def test_scores_that_need_gaussians_are_skipped(sequence: FrameSequence, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(model, "LONGEST_SECONDS", 0.0)
    scene: RadianceScene = started(sequence, "endonerf").scene()
    found = evaluate(scene, sequence, networks=False)
    assert {"psnr_tissue", "depth_rmse_mm", "fps"} <= found.scores.keys()
    assert (
        found.skipped["fps_cached"]
        == found.skipped["num_gaussians"]
        == "needs the Gaussians of a scene; this one has none"
    )
    for name in ("depth_instability_mm", "flow_error_dis_adjacent", "psnr_train"):
        assert found.skipped[name] == context.TOO_SLOW and name not in found.scores
    assert found.protocol["backend"] == "torch, 10 samples per ray"
    with pytest.raises(InputError, match="expected a scene of Gaussians, got a radiance field"):
        len(scene)
    assert scene, "it is there, though it has no length"


def test_it_trains_as_a_call_that_another_machine_can_do(sequence: FrameSequence, tmp_path: Path):
    run = start_run(sequence, tiny("endonerf", 2), tmp_path / "run", say=[].append)
    (training,) = trainings(run)
    assert " Gaussians" not in str(train_here(training))
    assert isinstance(load_scene(tmp_path / "run"), RadianceScene)


def test_presets_of_both_sizes():
    for name in NAMES:
        assert preset(name) == getattr(presets_radiance, name)() and preset(name).method == name
        assert preset(f"{name}-published").method == name


def test_a_run_folder_is_like_any_other(sequence: FrameSequence, tmp_path: Path):
    cfg = tiny("endonerf", 3)
    scene = train(sequence, cfg, tmp_path / "run", progress=False)
    again = train(sequence, cfg, tmp_path / "run", resume=True, progress=False)  # there is nothing left to do
    loaded = load_scene(tmp_path / "run")
    assert isinstance(loaded, RadianceScene) and loaded.config == scene.config
    for other in (again, loaded):
        assert same(dict(scene.field.state_dict()), dict(other.field.state_dict()))
    with pytest.raises(InputError, match="expected a scene of Gaussians, got a radiance field"):
        open_gaussians(tmp_path / "run")
    for use in (lambda: loaded.at(0.5), lambda: export(loaded, tmp_path / "x.ply")):
        with pytest.raises(InputError, match=r"scene: expected a scene of Gaussians, got a radiance field"):
            use()
    assert not (tmp_path / "x.ply").exists()
