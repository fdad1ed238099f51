"""Write a synthetic sequence with ground truth: build the anatomy once, then deform, render and expose each frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.geometry import strain_between
from ..data.sequence import is_test_frame
from ..data.writer import FrameFiles, SequenceMeta, new_sequence
from .camera import AT_ORIGIN, CameraPose
from .config import PhantomConfig
from .events import is_mirrored, parse_events, shows_body
from .recording import Exposure, RecordedFrame, RenderedFrame, record, render_frame, rows_after_cuts, with_events
from .scene import PhantomScene, build_scene
from .sensor import develop, vignette
from .sheet import tangents
from .sinus import build_sinus
from .texture import smooth_patches
from .tube import build_tube, write_tube
from .views import pixel_hits, render_tissue, shown_elsewhere, side_cameras, side_view, visible_points

Mask = NDArray[np.bool_]
RED = (250, 10, 20)
CUT = 0.2  # Length of the cut corners, as a share of the height


def border(cfg: PhantomConfig) -> Mask:
    """(H, W) True outside of the image."""
    width, height = cfg.width, cfg.height
    seen, cut = np.zeros((height, width), np.uint8), round(CUT * height)
    right, down = width - 1, height - 1
    if cfg.border == "octagon":
        half = [(cut, 0), (right - cut, 0), (right, cut), (right, down - cut)]
        corners = [*half, *((right - x, down - y) for x, y in half)]
        cv2.fillPoly(seen, [np.array(corners, np.int32)], 1)
    elif cfg.border == "oval":
        cv2.ellipse(seen, (width // 2, height // 2), (round(0.46 * width), round(0.47 * height)), 0, 0, 360, 1, -1)
    elif cfg.border == "rounded":
        seen[cut:-cut, cut:-cut] = 1
        seen = np.asarray(cv2.dilate(seen, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * cut + 1,) * 2)), np.uint8)
    else:
        seen[:] = 1
    return seen == 0


def overlay(cfg: PhantomConfig, index: int) -> Mask:
    """(H, W) True on the box and text of a frame; every fourth frame has none."""
    drawn, (width, height) = np.zeros((cfg.height, cfg.width), np.uint8), (cfg.width, cfg.height)
    if not cfg.overlay or index % 4 == 3:
        return drawn > 0
    x = round(width * (0.25 + 0.2 * np.sin(index / 7)))
    y = round(height * (0.3 + 0.2 * np.cos(index / 5)))
    thick = max(1, round(height / 200))
    cv2.rectangle(drawn, (x, y), (x + round(0.3 * width), y + round(0.3 * height)), 1, thick)
    cv2.putText(drawn, f"0.{(37 * index) % 100:02d}", (x, y - 4), cv2.FONT_HERSHEY_SIMPLEX, height / 350, 1, thick)
    return drawn > 0


def surrounded(image: NDArray[np.uint8], outside: Mask, drawn: Mask) -> NDArray[np.uint8]:
    """The image (H, W, 3) with a black outside, and the drawing over it."""
    image = np.where(outside[..., None], np.uint8(0), image)
    return np.where(drawn[..., None], np.array(RED, np.uint8), image)


_LOOKS = 12
"""Views in each excursion in which tracked points are chosen."""


def choose_tracks(scene: PhantomScene) -> NDArray[np.int64]:
    """(P, 2) mesh rows and columns to track: two thirds spread over what is seen, the rest near the pulls.

    A camera that stands still has seen enough in the first image.
    """
    cfg = scene.cfg
    rng = np.random.default_rng([cfg.seed, 5])
    seen = np.zeros(scene.a.shape, bool)
    looks = _LOOKS * len(scene.path.excursions) + 1
    for phase in np.arange(looks) / max(looks - 1, 1):
        vertices = scene.seen_vertices(phase)
        seen |= visible_points(
            vertices, pixel_hits(vertices, cfg)[..., 2], np.zeros((cfg.height, cfg.width), bool), cfg
        )
    rows, columns = np.nonzero(seen)
    pull = np.sum([p.weight(scene.a, scene.b) for p in scene.motion.pulls], 0)[rows, columns]
    spread = min(cfg.tracks * 2 // 3, len(rows))
    # np.nonzero lists vertices row by row: even steps through the list cover what is seen.
    even = np.linspace(0, len(rows) - 1, spread).astype(int) if spread else np.zeros(0, int)
    weight = pull**2
    weight[even] = 0
    extra = min(cfg.tracks - spread, int((weight > 0).sum()))
    near_pulls = rng.choice(len(rows), extra, replace=False, p=weight / weight.sum()) if extra else even[:0]
    chosen = np.sort(np.concatenate([even, near_pulls]))
    return np.stack([rows[chosen], columns[chosen]], -1)


def _regions(scene: PhantomScene, tracked: NDArray[np.int64]) -> NDArray[np.str_]:
    """(P,) `pulled`: moved by at least half of a pull; else `smooth`: hardly any texture; else `spread`."""
    share = scene.cfg.smooth_share
    pulled = np.max([pull.weight(scene.a, scene.b) for pull in scene.motion.pulls], 0) >= 0.5
    smooth = share > 0 and smooth_patches(scene.a, scene.b, scene.cfg.seed, share) > 0.5
    names = np.where(pulled, "pulled", np.where(smooth, "smooth", "spread"))
    return names[tracked[:, 0], tracked[:, 1]]


def write_phantom(
    out: str | Path,
    cfg: PhantomConfig | None = None,
    progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> None:
    """Write a synthetic sequence folder with ground truth to `out`.

    Beside the sequence (images, masks, depth, poses, `sequence.json`) it writes

    - `truth/tissue/*.png`, the image without tools and without sensor noise. Tools cast no shadow, so outside of them
      an image is the truth plus noise;
    - `truth/no_highlights/*.png`, the same in test frames without the highlights of the wet film; not with smoke as
      `cfg.tissue`;
    - `truth/depth/*.npy`, (H, W) float32 z of the tool-free tissue, mm;
    - `truth/seen/*.npy`, (H, W) bool in test frames: behind a tool, and some training frame shows that tissue;
    - `truth/tracks.npz`: `points` (T, P, 3) float32 mm in the axes of the frame's camera, `visible` (T, P) bool, False
      behind tools, border and overlay; with `cfg.has_regions` also `region` (P,);
    - with `cfg.side_views` `truth/side/NAME/*.png` and `*.npy`: picture and depth of the side cameras in test frames,
      0 where the endoscope does not see the tissue; `truth/side/world_to_camera.json` has their poses (4, 4);
    - with `cfg.stereo` `right/*.png` and `calibration.json`;
    - with `cfg.has_kinds` `truth/scene.json`: kinds of tools and tissue, names of the tools, events, the density of
      smoke in each frame, 0..1, and its exposure relative to the first one. `truth/tissue` has the exposure of the
      first frame and shows the smoke of `cfg.tissue`, not that of `cfg.smoke`; the side cameras see none;
    - with `cfg.border` `truth/border.npy`, (H, W) bool, True outside; with `cfg.overlay` `truth/overlay/*.npy`, True
      on the drawing;
    - of the scenes `tube` and `sinus` only tissue, depth, tracks and the camera's poses;
    - with `cfg.mechanics` `truth/mechanics.npz`: of the tracked points, since the first frame, `displacement` (T, P, 3)
      mm, principal `stretch` (T, P, 2), `direction` (T, P, 3) of the larger one in the first frame and `area` (T, P)
      after over before, float32, in the axes of the first frame's camera;
    - with a moving `cfg.camera` `truth/camera_to_world.npy` (T, 4, 4), mm, as in `poses_bounds.npy`.

    Args:
        out: a new or empty folder; it appears when complete.
        progress: called with (frames done, frames) after each frame.
    Raises:
        InputError: `out` is in use.

    Example:
        >>> import endoprior
        >>> from endoprior.phantom import PhantomConfig
        >>> endoprior.phantom("DATA", PhantomConfig(frames=10, width=64, height=48))
    """
    out, cfg = Path(out), cfg or PhantomConfig()
    with new_sequence(out, _meta(cfg)) as writer:
        outside = border(cfg)
        if cfg.border != "none":
            writer.write_array("truth/border.npy", outside)
        if cfg.scene == "cavity":
            _write_cavity(writer, build_scene(cfg), outside, progress)
        else:
            write_tube(writer, build_tube(cfg) if cfg.scene == "tube" else build_sinus(cfg), cfg, outside, progress)


def _write_cavity(writer: FrameFiles, scene: PhantomScene, outside: Mask, progress: Callable[[int, int], None]) -> None:
    """Write frames, black and without depth `outside` (H, W), and all truth of the scene `cavity`."""
    cfg = scene.cfg
    events, lens = parse_events(cfg.events, cfg.frames), vignette(cfg.width, cfg.height)
    tracked, points, visible = choose_tracks(scene), [], []
    behind_tools, sides = _BehindTools(scene), {}
    exposure, gains = None, []
    for index in range(cfg.frames):
        frame, drawn, rows = render_frame(scene, index), overlay(cfg, index), rows_after_cuts(events, index)
        if exposure is None:
            exposure = Exposure.of_first(scene, frame)
            sides = side_cameras(float(np.median(frame.z))) if cfg.side_views else {}
        gains.append(exposure.now / exposure.first)
        in_body = shows_body(events, index)
        hidden = frame.tool_mask | (outside | drawn)[rows]
        seen = visible_points(frame.now.vertices, frame.z, hidden, cfg) & in_body
        behind_tools.add(index, frame.tool_mask & in_body, seen, rows)
        points.append(frame.now.vertices[tracked[:, 0], tracked[:, 1]])
        visible.append(seen[tracked[:, 0], tracked[:, 1]] & (not is_mirrored(events, index)))
        _write_truth(writer, scene, frame, exposure.first, lens, rows)
        if is_test_frame(index):
            _write_sides(writer, scene, frame, exposure.first, sides)
        recorded = with_events(record(scene, frame, exposure.now, lens), events, index, cfg.seed)
        _write_recorded(writer, recorded, outside, drawn)
        if cfg.gain == "auto":
            exposure = exposure.after(frame)
        progress(index + 1, cfg.frames)
    behind_tools.write(writer)
    _write_tracks(writer, scene, tracked, points, visible)
    _write_descriptions(writer, scene, sides, gains)


class _BehindTools:
    """Where the tools of test frames cover tissue that training frames show, which is known after the last frame."""

    def __init__(self, scene: PhantomScene) -> None:
        self._scene = scene
        self._trained_on = np.zeros(scene.a.shape, bool)  # (MH, MW) vertices that some training frame shows
        self._tools: dict[int, tuple[NDArray[np.uint8], slice]] = {}  # packed mask and rows of each test frame

    def add(self, index: int, tool: Mask, seen: Mask, rows: slice) -> None:
        """Note a frame with the mask `tool` (H, W), in which the vertices `seen` (MH, MW) are visible.

        Args:
            rows: in which order it is written.
        """
        if is_test_frame(index):
            self._tools[index] = np.packbits(tool), rows
        else:
            self._trained_on |= seen

    def write(self, writer: FrameFiles) -> None:
        """Write `truth/seen`."""
        cfg = self._scene.cfg
        for index, (packed, rows) in self._tools.items():
            hits = pixel_hits(self._scene.seen_vertices(index / (cfg.frames - 1)), cfg)
            tool = np.unpackbits(packed, count=hits[..., 0].size).reshape(hits.shape[:2]) > 0
            writer.write_array(f"truth/seen/{index:06d}.npy", shown_elsewhere(hits, self._trained_on, tool)[rows])


def _write_recorded(writer: FrameFiles, recorded: RecordedFrame, outside: Mask, drawn: Mask) -> None:
    """Append a frame, with the border and the drawing over its images."""
    right = None if recorded.right is None else surrounded(recorded.right, outside, drawn)
    depth = np.where(outside, np.float32(0), recorded.depth)
    writer.add(surrounded(recorded.image, outside, drawn), recorded.tool_mask | outside | drawn, depth, right)


def _write_truth(
    writer: FrameFiles, scene: PhantomScene, frame: RenderedFrame, gain: float, lens: NDArray[np.float32], rows: slice
) -> None:
    """What lies behind the tools of a frame: tissue and depth; in test frames also the tissue without highlights,
    unless smoke as a kind of tissue veils it. And where the drawing is.
    """
    index, cfg = frame.index, scene.cfg

    def write_tissue(folder: str, radiance: NDArray) -> None:
        writer.write_image(folder, np.round(develop(radiance, gain, lens)).astype(np.uint8)[rows], index)

    write_tissue("truth/tissue", frame.view.tissue)
    writer.write_array(f"truth/depth/{index:06d}.npy", frame.z[rows])
    if is_test_frame(index) and (scene.smoke is None or cfg.smoke):
        write_tissue("truth/no_highlights", render_tissue(scene, frame.now, AT_ORIGIN, highlights=False)[0])
    if cfg.overlay:
        writer.write_array(f"truth/overlay/{index:06d}.npy", overlay(cfg, index))


def _write_sides(
    writer: FrameFiles, scene: PhantomScene, frame: RenderedFrame, gain: float, sides: dict[str, CameraPose]
) -> None:
    """What the side cameras see of a frame: image and depth."""
    for name, pose in sides.items():
        image, depth = side_view(scene, frame.now, pose, frame.z, frame.tool_mask, gain)
        writer.write_image(f"truth/side/{name}", image, frame.index)
        writer.write_array(f"truth/side/{name}/{frame.index:06d}.npy", depth)


def _write_tracks(
    writer: FrameFiles, scene: PhantomScene, tracked: NDArray[np.int64], points: list[NDArray], visible: list[NDArray]
) -> None:
    """The tracks, from `points` (P, 3) and `visible` (P,) of each frame; how their tissue is deformed."""
    regions = {"region": _regions(scene, tracked)} if scene.cfg.has_regions else {}
    tracks = {"points": np.stack(points).astype(np.float32), "visible": np.stack(visible)}
    writer.write_arrays("truth/tracks.npz", **tracks, **regions)
    if scene.cfg.mechanics != "none":
        writer.write_arrays("truth/mechanics.npz", **_deformed(scene, tracked))


def _deformed(scene: PhantomScene, tracked: NDArray[np.int64]) -> dict[str, NDArray[np.float32]]:
    """What `truth/mechanics.npz` says of the tracked vertices (P, 2); the tissue is undeformed in the first frame."""
    rows, columns = tracked.T
    rest = scene.vertices(0)
    found: dict[str, list[NDArray]] = {"displacement": [], "stretch": [], "direction": [], "area": []}
    for index in range(scene.cfg.frames):
        now = scene.vertices(index / (scene.cfg.frames - 1))
        strain = strain_between(tangents(rest)[rows, columns], tangents(now)[rows, columns])
        values = ((now - rest)[rows, columns], strain.stretch, strain.direction, strain.area)
        for name, value in zip(found, values, strict=True):
            found[name].append(value)
    return {name: np.stack(values).astype(np.float32) for name, values in found.items()}


def _write_descriptions(
    writer: FrameFiles, scene: PhantomScene, sides: dict[str, CameraPose], gains: list[float]
) -> None:
    """Poses of the cameras, the calibration of the pair, and kinds of tools and tissue, where they are not obvious."""
    cfg = scene.cfg
    if scene.path.excursions:
        writer.camera_to_world = scene.path.poses(cfg.frames)
        writer.write_array("truth/camera_to_world.npy", writer.camera_to_world)
    if sides:
        poses = {name: pose.world_to_camera.tolist() for name, pose in sides.items()}
        writer.write_json("truth/side/world_to_camera.json", poses)
    if cfg.stereo:
        (cx, cy), focal = cfg.center, cfg.focal
        matrix, undistorted = [[focal, 0, cx], [0, focal, cy], [0, 0, 1]], [0, 0, 0, 0, 0]
        calibration = {
            "layout": "two folders, images/ for the left eye and right/ for the right one, already rectified",
            "width": cfg.width,
            "height": cfg.height,
            "pixel_center": 0.5,
            "K_left": matrix,
            "K_right": matrix,
            "distortion_left": undistorted,
            "distortion_right": undistorted,
            "R": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
            "T_mm": [-cfg.baseline_mm, 0, 0],
        }
        writer.write_json("calibration.json", calibration)
    if cfg.has_kinds:
        tools = [tool.name for tool in scene.instruments]
        described: dict[str, object] = {"instruments": cfg.instruments, "tools": tools, "tissue": cfg.tissue}
        if cfg.events:
            described["events"] = [asdict(event) for event in parse_events(cfg.events, cfg.frames)]
        if scene.smoke is not None:
            described["smoke"] = [round(scene.smoke.density(k / (cfg.frames - 1)), 4) for k in range(cfg.frames)]
        if cfg.gain == "auto":
            described["gain"] = [round(gain, 5) for gain in gains]
        writer.write_json("truth/scene.json", described)


def _meta(cfg: PhantomConfig) -> SequenceMeta:
    """What `sequence.json` says."""
    kinds = f", instruments {cfg.instruments}, tissue {cfg.tissue}" if cfg.has_kinds else ""
    kinds += f", mechanics {cfg.mechanics}" if cfg.mechanics != "none" else ""
    kinds += f", scene {cfg.scene}" if cfg.scene != "cavity" else ""
    made = f"synthetic (endoprior phantom, seed {cfg.seed}{kinds})"
    return SequenceMeta(
        width=cfg.width,
        height=cfg.height,
        fx=cfg.focal,
        fy=cfg.focal,
        cx=cfg.center[0],
        cy=cfg.center[1],
        frames_per_second=cfg.frames_per_second,
        baseline_mm=cfg.baseline_mm,
        depth_source="synthetic stereo",
        note=f"{made}; truth/tissue is free of tools and of sensor noise",
    )
