"""Pure functions of the viewer: playback, canvas, lines, measuring, video paths, points, files."""

from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from endoprior.core.geometry import project
from endoprior.core.types import Camera
from endoprior.data.images import encode_png
from endoprior.view.browsers import Browsers
from endoprior.view.layers import NO_LINES, draw_lines, render_points, ruler, track_lines
from endoprior.view.measure import Measurement, measurement_text, pick
from endoprior.view.panel import POINTS_OF
from endoprior.view.saving import keep, video_file
from endoprior.view.viewable import frame_due, shrink_factor
from endoprior.view.viewport import (
    PathPoint,
    bounded_aspect,
    endoscope_viewport,
    follow_frames,
    free_viewport,
    interpolate,
)

CAMERA = Camera(64, 48, 80.0, 80.0, 32.0, 24.0, np.eye(4))
OFF_CENTER = Camera(64, 48, 80.0, 80.0, 30.0, 27.0, np.eye(4))


def test_playback_repeats_at_its_rate():
    assert [frame_due(8, seconds, 10.0, 12) for seconds in (0, 0.09, 0.1, 0.35, 0.4, 1.25)] == [8, 8, 9, 11, 0, 8]


def test_only_slow_moving_images_are_halved():
    assert [shrink_factor(0.0, 30.0), shrink_factor(0.0, 90.0), shrink_factor(1.0, 90.0)] == [1, 2, 1]


@pytest.mark.parametrize("camera", (CAMERA, OFF_CENTER))
@pytest.mark.parametrize("aspect", (0.5, 4 / 3, 2.5))
@pytest.mark.parametrize("shrink", (1, 2))
def test_the_canvas_contains_the_image_with_a_centered_principal_point(camera, aspect, shrink):
    viewport = endoscope_viewport(camera, aspect, shrink)
    assert viewport.pixel((0.5, 0.5)) == pytest.approx((viewport.camera.cx, viewport.camera.cy), abs=0.51)
    assert viewport.width / viewport.height == pytest.approx(aspect, rel=0.06)  # sizes are whole even numbers
    assert viewport.camera.width == 64 // shrink and viewport.fov == pytest.approx(
        2 * np.arctan(viewport.height / 2 / (80 / shrink))
    )
    picture = np.full((48 // shrink, 64 // shrink, 3), 200, np.uint8)
    canvas = viewport.paste(picture)
    assert canvas.shape == (viewport.height, viewport.width, 3)
    assert (canvas == 200).sum() == picture.size
    screen = viewport.screen((3.5, 5.5))
    x, y = (int(share * size) for share, size in zip(screen, (viewport.width, viewport.height), strict=True))
    assert canvas[y, x].tolist() == [200] * 3 and viewport.pixel(screen) == pytest.approx((3.5, 5.5))


def test_pixels_that_are_not_square_become_square():
    viewport = endoscope_viewport(replace(CAMERA, fx=40.0), 1.5)
    assert (viewport.camera.width, viewport.camera.fx, viewport.camera.cx) == (128, 80.0, 64.0)


def test_a_browser_camera_becomes_a_viewport():
    half = np.sqrt(0.5)
    viewport = free_viewport(np.array([half, 0, half, 0]), np.array([1.0, 2, 3]), 0.8, 1.5, 100)
    pixels, z = project(np.array([[11.0, 2, 3]]), viewport.camera)  # turned by 90 degrees about y: looks along +x
    assert z[0] == pytest.approx(10) and pixels[0] == pytest.approx([75, 50])
    assert viewport.fov == pytest.approx(0.8) and (viewport.width, viewport.height) == (150, 100)


@pytest.mark.parametrize(
    "wxyz, position, fov",
    (([np.nan, 0, 0, 0], [0, 0, 0], 1.0), ([0, 0, 0, 0], [0, 0, 0], 1.0), ([1, 0, 0, 0], [0, np.inf, 0], 1.0)),
)
def test_an_invalid_camera_gives_no_viewport(wxyz, position, fov):
    assert free_viewport(np.array(wxyz), np.array(position), fov, 1.0, 100) is None
    assert free_viewport(np.array([1.0, 0, 0, 0]), np.zeros(3), -2.0, 1.0, 100) is None


def test_empty_canvases_have_an_aspect():
    assert [bounded_aspect(0, 10), bounded_aspect(10, 0), bounded_aspect(1000, 1), bounded_aspect(3, 2)] == [
        1,
        1,
        4,
        1.5,
    ]


def test_track_lines_end_at_the_frame_and_skip_unknown_points():
    paths = np.zeros((12, 2, 3))
    paths[:, 0, 0] = np.arange(12)
    paths[5, 1] = np.nan
    sure = np.ones((12, 2), bool)
    marks = track_lines(paths, 10, sure)
    first = marks.segments[(marks.colors == marks.colors[0]).all(1)]
    assert len(first) == 8 and first[-1, 1, 0] == 10 and first[0, 0, 0] == 2
    assert np.isfinite(marks.segments).all() and len(marks) == 8 + 6
    assert marks.dots.sum() == 2 and len(track_lines(paths, 0, sure)) == 2
    sure[8:, 0] = False
    faded = track_lines(paths, 10, sure)
    assert faded.dots.tolist().count(True) == 1 and np.array_equal(faded.segments, marks.segments)
    darker = faded.colors.max(1) < 0.5 * marks.colors.max(1)
    assert marks.segments[darker, 1, 0].tolist() == [8, 9, 10], "where the first point is hidden or uncertain"


def test_lines_are_drawn_at_their_projection():
    ends = np.array([[-5.0, 0, 50], [5, 0, 50]])
    marks = NO_LINES + ruler(ends)
    picture = draw_lines(np.zeros((48, 64, 3), np.uint8), CAMERA, marks)
    rows, columns = np.nonzero(picture.any(-1))
    assert abs(rows.mean() - 23.5) < 0.6 and 19 <= columns.min() and columns.max() <= 44
    assert picture[23:25, 25:40].any(0).any(-1).all()
    behind = replace(marks, segments=marks.segments * [1, 1, -1])
    assert not draw_lines(np.zeros((48, 64, 3), np.uint8), CAMERA, behind).any()
    assert len(ruler(ends[:0])) == 0 and len(ruler(ends[:1])) == 1


def test_a_click_picks_the_surface_point():
    depth = np.zeros((48, 64), np.float32)
    depth[10, 20] = 40
    assert pick(depth, CAMERA, (20.5, 10.5)) == pytest.approx([(20.5 - 32) / 80 * 40, (10.5 - 24) / 80 * 40, 40])
    for nowhere in ((21.5, 10.5), (-1.0, 3.0), (70.0, 3.0), (np.nan, 3.0), (np.inf, 3.0)):
        assert pick(depth, CAMERA, nowhere) is None


def test_a_measurement_reports_distance_and_change():
    paths = np.zeros((3, 2, 3))
    paths[:, 1, 0] = 4, 5, 7
    measured = Measurement(1, paths)
    assert measured.curve("Distance").tolist() == [4, 5, 7]
    text = measurement_text(measured, 2, relative=False)
    assert "7.00 mm" in text and "+2.00 since frame 1" in text and "4.00 to 7.00" in text
    text = measurement_text(measured, 2, relative=True)
    assert "**7.00 rel.**" in text
    paths[[0, 2]] = np.nan
    measured = Measurement(1, paths)
    assert "**5.00 mm**" == measurement_text(measured, 1, relative=False)
    assert "frame 1" in measurement_text(measured, 0, relative=False) and len(measured.ends(0)) == 0
    assert "one more point" in measurement_text(Measurement(0, paths[:, :1]), 0, relative=False)


def test_a_video_follows_the_frames_or_the_saved_views():
    cameras = (CAMERA, OFF_CENTER)
    assert [place.camera for place in follow_frames(cameras, None)] == list(cameras)
    assert {place.camera.cx for place in follow_frames(cameras, OFF_CENTER)} == {30.0}
    away = np.eye(4)
    away[:3, 3] = -10, 0, 0
    moved = replace(CAMERA, world_to_camera=away)
    beside = [place.camera.center.tolist() for place in follow_frames((CAMERA, moved), moved, rides_from=0)]
    assert beside == [[10, 0, 0], [20, 0, 0]], "it keeps its place beside the endoscope"
    path = interpolate([PathPoint(frame, camera) for frame, camera in ((2, CAMERA), (6, moved), (5, CAMERA))])
    assert [place.frame for place in path] == [2, 3, 4, 5, 6, 5]
    assert [place.camera.center[0] for place in path] == pytest.approx([0, 2.5, 5, 7.5, 10, 0])
    assert len({(place.camera.width, place.camera.height) for place in path}) == 1
    wide = replace(CAMERA, width=2 * CAMERA.width, height=2 * CAMERA.height, fy=2 * CAMERA.fy)
    path = interpolate([PathPoint(0, CAMERA), PathPoint(2, wide), PathPoint(4, wide)])
    assert {(place.camera.width, place.camera.height, place.camera.fy) for place in path} == {
        (CAMERA.width, CAMERA.height, CAMERA.fy)
    }, "views of browsers of other sizes"


def test_the_nearest_point_is_on_top():
    points = np.array([[0.0, 0, 60], [0, 0, 50], [0, 0, -5]], np.float32)
    colors = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255]], np.uint8)
    for order in ([0, 1, 2], [2, 1, 0]):
        picture, depth = render_points(points[order], colors[order], 1.0, CAMERA)
        assert picture[24, 32].tolist() == [0, 255, 0] and depth[24, 32] == 50
        assert (depth > 0).sum() < 16
    assert not render_points(points[2:], colors[2:], 1.0, CAMERA)[0].any()


def test_files_are_never_overwritten_and_stay_in_the_folder(tmp_path):
    picture = np.zeros((8, 8, 3), np.uint8)
    first, second = (keep(tmp_path / "view", "a.png", encode_png(picture)) for _ in range(2))
    assert first != second and first.read_bytes() == second.read_bytes()
    assert b"ftyp" in video_file([picture] * 3, 10.0)[:32]
    for name in ("../a.png", "/etc/a.png", "b/a.png", ".."):
        with pytest.raises(ValueError, match="plain file name"):
            keep(tmp_path / "view", name, b"")


def test_the_measured_quantity_is_told_with_its_unit_and_reference():
    paths = np.zeros((3, 3, 3))
    paths[:, 1, 0], paths[:, 2, 1] = (4, 4, 8), 3
    paths[:, :, 2] = np.array([0, 1, 2])[:, None]
    measured = Measurement(0, paths, np.array([[1.0], [1.02], [1.1]]).repeat(3, 1), since=1)
    text = {quantity: measurement_text(measured, 2, False, quantity) for quantity in POINTS_OF}
    assert "**12.00 mm²**" in text["Area"] and "+6.00 since frame 0" in text["Area"]
    assert "**2.00 mm**" in text["Path length"] and "2.00 without smoothing" in text["Path length"]
    assert "**1.00 mm**" in text["Displacement"] and "since frame 1; 0.00 to 1.00" in text["Displacement"]
    assert text["Stretch"].startswith("**1.100**")
    assert "rel.²" in measurement_text(measured, 2, True, "Area")
    assert len(measured.ends(2, "Area")) == 4 and len(measured.ends(2)) == 3
    two = Measurement(0, paths[:, :2])
    assert "one more point" in measurement_text(two, 0, False, "Area")
    assert "Unknown" in measurement_text(two, 0, False, "Stretch")
    crossed = Measurement(0, np.array([[[0.0, 0, 0], [2, 2, 0], [2, 0, 0], [0, 1, 0]]]))
    assert "cross" in measurement_text(crossed, 0, False, "Area")


def test_browsers_ride_along_with_the_endoscope():
    """A browser 5 mm beside the endoscope stays 5 mm beside it, turned as it is."""
    turned = np.eye(4)
    turned[:3, :3] = [[0, 0, -1], [0, 1, 0], [1, 0, 0]]  # the camera looks along -x
    place = {
        "position": np.array([5.0, 0, 0]),
        "look_at": np.array([5.0, 0, 60]),
        "up_direction": np.array([0, -1.0, 0]),
    }
    camera = SimpleNamespace(**place)
    client = SimpleNamespace(client_id=0, camera=camera, atomic=nullcontext)
    browsers = Browsers(SimpleNamespace(get_clients=lambda: {0: client}))
    browsers.join(client)
    browsers.ride(CAMERA, CAMERA)
    np.testing.assert_array_equal(camera.position, [5, 0, 0])
    browsers.ride(CAMERA, replace(CAMERA, world_to_camera=turned))
    np.testing.assert_allclose(camera.position, [0, 0, -5], atol=1e-12)
    np.testing.assert_allclose(camera.look_at, [60, 0, -5], atol=1e-12)
    np.testing.assert_allclose(camera.up_direction, [0, -1, 0], atol=1e-12)
