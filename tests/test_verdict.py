"""The references that the video gives, and the word that is said of a model."""

from dataclasses import replace

import numpy as np
import pytest
from known_surface import NORMAL, OFFSET, pose, seen, turned

from endoprior.cli.run import last_words
from endoprior.core.types import Camera, Frame
from endoprior.evaluation.scorers.image import psnr_tissue
from endoprior.evaluation.scorers.references import follow, mean_image, moved_frame, relief_agreement, triangulated
from endoprior.evaluation.verdict import Verdict, VerdictFacts, verdict_on

WIDTH, HEIGHT = 160, 128
MATRIX = np.array([[150.0, 0, 80], [0, 150.0, 64], [0, 0, 1]])
GOOD_SCORES = {"psnr_tissue": 33.0, "gain_over_flow": -1.0, "gain_over_mean": 9.0, "slip_px": 1.0}


class Clip:
    """Frames of a painted plane from a camera that moves to the right, 0.4 mm a frame."""

    def __init__(self, count: int = 14, step_mm: float = 0.4) -> None:
        self.frames_, self.indices = [], list(range(count))
        for k in range(count):
            to_world = pose(turned(), (step_mm * k, 0, 0))
            camera = Camera(WIDTH, HEIGHT, 150, 150, 80, 64, np.linalg.inv(to_world))
            color, depth = seen(MATRIX, to_world, (WIDTH, HEIGHT))
            tissue = np.ones((HEIGHT, WIDTH), bool)
            self.frames_.append(Frame(k, k / count, camera, color, tissue, depth.astype(np.float32), depth > 0))

    def __len__(self) -> int:
        return len(self.frames_)

    def __getitem__(self, k: int) -> Frame:
        return self.frames_[k]

    frame = __getitem__

    def camera(self, k: int) -> Camera:
        return self.frames_[k].camera


def test_a_frame_moved_by_flow_is_nearly_the_one_it_is_moved_to():
    clip = Clip()
    held_out, training = clip[7], Clip()
    training.indices, training.frames_ = [5, 10], [clip[5], clip[10]]
    moved, known = moved_frame(training, held_out)
    still = psnr_tissue(clip[5].rgb, held_out.rgb, known)
    assert known.mean() > 0.9 and psnr_tissue(moved, held_out.rgb, known) > still + 6


def test_a_tool_in_the_nearest_frame_is_filled_from_the_other_side():
    clip = Clip()
    covered = clip[6].tissue_mask.copy()
    covered[40:80, 60:100] = False
    clip.frames_[6] = replace(clip[6], tissue_mask=covered, rgb_u8=np.where(covered[..., None], clip[6].rgb_u8, 255))
    clip.indices, clip.frames_ = [6, 9], [clip[6], clip[9]]
    moved, known = moved_frame(clip, Clip()[7])
    assert known[45:75, 65:95].all() and moved[45:75, 65:95].max() < 0.999
    clip.indices, clip.frames_ = [6], [clip[0]]
    alone, shown = moved_frame(clip, Clip()[7])
    assert shown.mean() < known.mean()
    np.testing.assert_array_equal(moved[shown], alone[shown])  # the farther frame fills in only


def test_the_mean_image_is_over_tissue():
    clip = Clip(2)
    left = np.arange(WIDTH) < 40
    clip.frames_[0] = replace(clip[0], tissue_mask=np.broadcast_to(~left, (HEIGHT, WIDTH)))
    mean = mean_image(clip)
    np.testing.assert_allclose(mean[:, left], clip[1].rgb[:, left], atol=1e-6)
    np.testing.assert_allclose(mean[:, ~left], (clip[0].rgb + clip[1].rgb)[:, ~left] / 2, atol=1e-6)


def test_followed_points_triangulate_to_the_plane():
    clip = Clip()
    followed = follow(clip, 0, 12)
    assert 80 < len(followed.start) < followed.tried and (followed.start % 10 == 5).all()  # centers of the grid's cells
    z, told = triangulated(followed.start, followed.end, clip.camera(0), clip.camera(12))
    assert told.mean() > 0.8
    rays = np.concatenate([(followed.start - (80, 64)) / 150, np.ones((len(z), 1))], 1)
    true = OFFSET / (rays @ NORMAL)
    assert np.median(np.abs(z / true - 1)[told]) < 0.02


def test_points_of_the_border_are_not_followed_where_the_scene_moves():
    def with_border(clip: Clip) -> Clip:
        border = np.random.default_rng(0).integers(0, 255, (HEIGHT, 40, 3)).astype(np.uint8)
        for k, frame in enumerate(clip.frames_):
            clip.frames_[k] = replace(frame, rgb_u8=np.concatenate([border, frame.rgb_u8[:, 40:]], 1))
        return clip

    moving, resting = (with_border(Clip(step_mm=step)) for step in (2.0, 0.0))
    assert (follow(resting, 0, 12).start[:, 0] < 30).sum() > 20, "without motion, they are as good as others"
    assert not (follow(moving, 0, 6).start[:, 0] < 30).any() and len(follow(moving, 0, 6).start) > 30


def test_rays_of_a_resting_camera_and_rays_that_miss_tell_no_depth():
    camera = Clip(2).camera(0)
    pixels = np.array([[20.0, 30.0], [90.0, 60.0]])
    assert not triangulated(pixels, pixels + 3, camera, camera)[1].any()
    nearly = replace(camera, world_to_camera=np.linalg.inv(pose(turned(), (0.5, 0, 0))))
    assert not triangulated(pixels, pixels - (1, 0), camera, nearly)[1].any()  # rays meet at 0.4 degrees
    beside = replace(camera, world_to_camera=np.linalg.inv(pose(turned(), (5.0, 0, 0))))
    end = pixels - (10, 0)
    assert triangulated(pixels, end, camera, beside)[1].all()
    assert not triangulated(pixels, end + np.array([0, 6]), camera, beside)[
        1
    ].any()  # moved tissue: off the epipolar line


@pytest.mark.parametrize(
    ("changes", "facts", "word", "reason"),
    [
        ({}, VerdictFacts(), "good", "1.0 dB below the nearest frame"),
        ({"psnr_tissue": 29.0, "gain_over_flow": -5.0}, VerdictFacts(), "usable", "5.0 dB below"),
        ({"psnr_tissue": 33.5, "gain_over_flow": -9.0}, VerdictFacts(), "good", "9.0 dB below"),
        ({"psnr_tissue": 27.0, "gain_over_flow": -9.0}, VerdictFacts(), "doubtful", "9.0 dB below"),
        (
            {"psnr_tissue": 25.0, "gain_over_mean": 0.9},
            VerdictFacts(),
            "wrong",
            "the mean of all frames alone has 24.1 dB",
        ),
        (
            {"psnr_tissue": 14.0, "gain_over_mean": -19.6},
            VerdictFacts(),
            "wrong",
            "the mean of all frames alone has 33.6 dB",
        ),
        (
            {"psnr_tissue": 25.0, "gain_over_mean": 2.5, "gain_over_flow": 0.5},
            VerdictFacts(),
            "doubtful",
            "does not follow",
        ),
        # Nothing moves: the mean image is as good as anything, and being a little below it is not wrong.
        ({"psnr_tissue": 34.0, "gain_over_flow": -1.5, "gain_over_mean": -0.5}, VerdictFacts(), "good", "1.5 dB below"),
        ({"slip_px": 6.0}, VerdictFacts(), "usable", "slips by 6.0 px"),
        ({"slip_px": 22.0}, VerdictFacts(), "doubtful", "slips by 22.0 px"),
        ({"depth_triangulated_error": 0.05}, VerdictFacts(depth_is_guessed=True), "good", "5% off"),
        ({"depth_triangulated_error": 0.5}, VerdictFacts(), "doubtful", "50% off"),
        ({}, VerdictFacts(depth_is_guessed=True), "usable", "a guess from one camera"),
        (
            {"depth_triangulated_error": 0.05},
            VerdictFacts(depth_measured=0.27),
            "usable",
            "parallax on 27% of the tissue",
        ),
        ({"depth_triangulated_error": 0.05}, VerdictFacts(depth_measured=0.7), "good", "5% off"),
        ({}, VerdictFacts(share_used=0.7), "usable", "70% of the frames"),
        ({}, VerdictFacts(share_used=0.3), "doubtful", "30% of the frames"),
        ({}, VerdictFacts(share_with_missed_tools=0.08), "usable", "missed in 8%"),
        ({}, VerdictFacts(share_with_missed_tools=0.17), "doubtful", "missed in 17%"),
        ({}, VerdictFacts(motion_is_unknown=True), "doubtful", "path is unknown"),
        ({}, VerdictFacts(findings=("camera-moves",)), "doubtful", "say that it is static"),
        ({}, VerdictFacts(findings=("depth-disparity",)), "doubtful", "near is far"),
        (
            {"depth_triangulated_error": 0.1, "depth_relief": -0.05},
            VerdictFacts(),
            "doubtful",
            "does not rise and fall",
        ),
        ({"depth_triangulated_error": 0.1, "depth_relief": 0.2}, VerdictFacts(), "good", "10% off"),
    ],
)
def test_the_worst_evidence_decides(changes, facts, word, reason):
    verdict = verdict_on(GOOD_SCORES | changes, facts)
    assert verdict.word == word and reason in verdict.reasons[0] + " ".join(verdict.reasons)


def test_flat_and_inverted_depth_have_no_relief():
    true = np.random.default_rng(0).normal(0, 0.1, 200)
    measured = true + np.random.default_rng(1).normal(0, 0.1, 200)
    sound, flat, inverted = (relief_agreement(np.stack([measured, told])) for told in (true, 0 * true, -true))
    assert sound > 0.6 and flat == 0 and inverted < -0.6
    assert np.isnan(relief_agreement(np.stack([measured, true])[:, :99])), "too few points"
    assert np.isnan(relief_agreement(np.stack([0.01 * true, true]))), "the tissue is flat"


def test_what_nothing_confirms_is_not_good():
    verdict = verdict_on({name: value for name, value in GOOD_SCORES.items() if name != "slip_px"}, VerdictFacts())
    assert verdict.word == "usable" and "too few points" in verdict.reasons[0]


SLIDES = ", but its tissue may not move as the real one does"


@pytest.mark.parametrize(
    ("changes", "facts", "plain"),
    [
        ({}, VerdictFacts(), "Good to look at; it can be measured"),
        ({}, VerdictFacts(lengths_are_relative=True), "Good to look at; do not measure: lengths are not millimeters"),
        ({}, VerdictFacts(motion_is_unknown=True), f"Good to look at{SLIDES}; do not measure"),
        ({"slip_px": 12.6}, VerdictFacts(), f"Good to look at{SLIDES}; do not measure"),
        ({"slip_px": 6.0}, VerdictFacts(), "Good to look at; measure with care"),
        ({}, VerdictFacts(share_used=0.7), "Good enough to look at; measure with care"),
        ({}, VerdictFacts(share_with_missed_tools=0.17), "Look at it only beside the video; do not measure"),
        ({"psnr_tissue": 20.0, "gain_over_mean": 0.5}, VerdictFacts(lengths_are_relative=True), "Wrong: do not use it"),
    ],
)
def test_plain_words_say_what_a_model_is_good_for(changes, facts, plain):
    assert verdict_on(GOOD_SCORES | changes, facts).plain == plain


def test_without_a_held_out_frame_nothing_is_good():
    assert verdict_on({}, VerdictFacts()).word == "doubtful"


def test_what_is_wrong_is_not_called_done(tmp_path):
    wrong, good = Verdict("wrong", ("worse",)), Verdict("good", ("33 dB",))
    measured = Verdict("good", ("33 dB",), "Good to look at; it can be measured")
    plain, done, figures = last_words(measured, "2 min", tmp_path).splitlines()
    assert plain == f"{measured.plain}." and done.startswith("Done") and figures == "Verdict: good: 33 dB."
    assert "Done" not in last_words(wrong, "2 min", tmp_path) and "wrong: worse" in last_words(wrong, "2 min", tmp_path)
    assert last_words(good, "2 min", tmp_path).startswith("Done in 2 min.")
    assert last_words(None, "2 min", tmp_path).startswith("Done in 2 min.")
