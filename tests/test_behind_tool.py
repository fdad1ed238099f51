"""Behind tools: where tissue is seen at another time, by the phantom, and what is scored there."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from endoprior.core.geometry import cells_at, project
from endoprior.data import load_sequence
from endoprior.evaluation.context import Evaluation, EvaluationContext
from endoprior.evaluation.scorers import other_views
from endoprior.phantom import PhantomConfig, write_phantom
from endoprior.phantom.views import shown_elsewhere

FRAMES = 20


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    """A phantom whose tools uncover some tissue and never uncover other."""
    out = tmp_path_factory.mktemp("phantom") / "sequence"
    write_phantom(out, PhantomConfig(frames=FRAMES, width=160, height=128, side_views=False))
    return load_sequence(out)


def test_a_pixel_is_that_of_the_nearest_vertex() -> None:
    seen = np.zeros((3, 5), bool)
    seen[1, 2] = True
    hits = np.zeros((1, 4, 3), np.float32)
    hits[0, :, :2] = [(0.5, 0.5), (0.55, 0.6), (0.8, 0.5), (0.5, 0.5)]
    tool = np.array([[True, True, True, False]])
    assert shown_elsewhere(hits, seen, tool).tolist() == [[True, True, False, False]]


def test_the_phantom_agrees_with_its_own_tracks(sequence) -> None:
    """A tracked point behind the tool that a training frame shows lies on a pixel that says so, and conversely."""
    tracks, training = sequence.truth.tracks, sequence.indices("train")
    ever, agreed, counted = tracks.visible[training].any(0), 0, 0
    for index in sequence.indices("test"):
        seen, frame = sequence.truth.seen(index), sequence.frame(index)
        assert seen.any() and (~frame.tissue_mask & ~seen).any() and not (seen & frame.tissue_mask).any()
        pixels, z = project(tracks.points[index].astype(np.float64), frame.camera)
        x, y = cells_at(pixels, 160, 128)
        hidden = ~frame.tissue_mask[y, x] & (np.abs(z - sequence.truth.depth(index)[y, x]) < 0.3)
        agreed += (seen[y, x] == ever)[hidden].sum()
        counted += hidden.sum()
    assert counted > 20 and agreed / counted > 0.9


def test_events_change_what_is_seen(tmp_path) -> None:
    """After a cut the truth is upside down as the images are; out of the body no frame shows any tissue."""
    cfg = PhantomConfig(frames=4, width=96, height=80, side_views=False)
    for name, events in (("plain", ""), ("cut", "cut:1"), ("outside", "out-of-body:0-0,out-of-body:2-3")):
        write_phantom(tmp_path / name, replace(cfg, events=events))
    plain, cut, outside = (np.load(tmp_path / name / "truth/seen/000001.npy") for name in ("plain", "cut", "outside"))
    assert plain.any() and np.array_equal(cut, plain[::-1]) and not outside.any()


def test_training_frames_have_none(sequence) -> None:
    assert sequence.truth.seen(0) is None


def scored(sequence, split: str, wrong=None) -> Evaluation:
    """Scores of a rendering that is off by 0.1 and 1 mm where it is `wrong` (20 dB), by 0.01 elsewhere (40 dB).

    Args:
        wrong: of a frame; None: color is where some training frame shows what the tool hides, depth is right.
    """
    rendered = {}
    for index in sequence.indices(split):
        seen = sequence.truth.seen(index) if wrong is None else wrong(index)
        error = np.where(False if seen is None else seen, 0.1, 0.01)[..., None]
        rgb = sequence.truth.tissue(index) / 255 + error
        depth = sequence.truth.depth(index) + (0 if wrong is None else wrong(index))
        rendered[index] = SimpleNamespace(rgb=rgb, depth=depth.astype(np.float32))
    context = SimpleNamespace(sequence=sequence, frames=sequence.frames(split), rendered=rendered)
    context.tissue_color = lambda index: rendered[index].rgb
    context.result = Evaluation({})
    for name in ("add", "add_mean", "skip_if_unavailable"):
        setattr(context, name, getattr(EvaluationContext, name).__get__(context))
    other_views.score_hidden(context)
    return context.result


def test_what_is_seen_and_what_is_guessed_are_scored_apart(sequence) -> None:
    scores = scored(sequence, "test").scores
    assert scores["psnr_behind_tool_seen"] == pytest.approx(20, abs=0.01)
    assert scores["psnr_behind_tool_guessed"] == pytest.approx(40, abs=0.01)
    assert 20 < scores["psnr_behind_tool"] < 40


@pytest.mark.parametrize("split", ["test", "video"])
def test_with_another_split_it_is_not_known_what_training_frames_show(sequence, split) -> None:
    """The truth names the frames that show it by the published split; the true tissue is that of every frame."""
    found = scored(sequence.with_test_phase(3), split)
    assert found.skipped["psnr_behind_tool_seen"] == found.skipped["psnr_behind_tool_guessed"] == other_views.NO_SEEN
    assert 20 < found.scores["psnr_behind_tool"] <= 40.01


def test_a_border_and_drawings_are_no_tools(tmp_path) -> None:
    """Only there the rendering is wrong, which masks of tools cover as well."""
    write_phantom(tmp_path / "s", PhantomConfig(frames=4, width=96, height=80, border="oval", overlay=True))
    sequence = load_sequence(tmp_path / "s")
    over = sequence.truth.printed_over(1)
    hidden = ~sequence.frame(1).tissue_mask
    assert (over & hidden).any() and (hidden & ~over).any() and not (over & sequence.frame(1).tissue_mask).any()
    scores = scored(sequence, "test", lambda index: sequence.truth.printed_over(index)).scores
    assert scores["psnr_behind_tool"] == pytest.approx(40, abs=0.01)
    assert scores["depth_rmse_behind_tool_mm"] == 0
