"""The options of `endoprior phantom`: size, motion and noise of the synthetic sequence."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Literal, get_args, get_origin, get_type_hints

from ..core.checks import input_error, or_did_you_mean
from .events import parse_events

MAX_PIXELS = 3840 * 2160
GB_PER_PIXEL = 1.3e-6
"""Memory for writing, measured at 1920x1080."""
MOVING_SHARE = 4
"""A camera that moves sees up to this many times as much tissue, which takes that much more memory."""
WIDEST_MOVING = 0.75
"""Least focal length of a moving camera, as a share of the longer side of the image."""

Instruments = Literal[
    "graspers", "gray_blue", "black", "white_plastic", "steel", "gold", "green", "blue", "mixed"
]  # fmt: skip
Tissue = Literal["bowel", "pale", "fat", "purple", "liver", "warm", "smoke", "blood"]

NARROW_PULL_MM = 15.0
"""Up to this pull, mm, the moved neighborhood keeps its size; beyond, it grows in proportion, or tissue would fold."""
MAX_MECHANICS_MM = 12.0
"""Largest pull of `mechanics`, mm: of 60 pulls (seeds 0 to 19) by 12 mm none folds the tissue, of 60 by 15 mm one."""


def _require(name: str, value: float, low: float, high: float) -> None:
    """Raise InputError unless low <= value <= high (NaN fails)."""
    if not low <= value <= high:
        raise input_error(name, f"a value in [{low:g}, {high:g}]", repr(value), "Choose a value in this range.")


@dataclass(frozen=True)
class PhantomConfig:
    """A synthetic operation: breathing bowel under a liver edge, a grasper that pulls it, a second moving tool."""

    scene: Literal["cavity", "tube", "sinus"] = "cavity"
    """`tube`: instead, the camera drives forward through a bent tube with folds, as a colon, without tools; `sinus`: in
    and out of a narrow nasal cavity."""
    frames: int = 48
    """Number of frames, 2..10000. The tool grasps, pulls and releases about once every 48 frames."""
    width: int = 640
    """Image width, 32..4096 px. The largest image is 3840x2160 px, which needs 11 GB of memory."""
    height: int = 512
    """Image height, 32..4096 px."""
    seed: int = 0
    """Seed of anatomy, texture, motion and noise. The same seed gives the same bytes."""
    instruments: Instruments = "graspers"
    """Family of the two tools, by their color; `mixed`: one each of two families, printed and worn."""
    tissue: Tissue = "bowel"
    """Kind of tissue and view: its color, vessels and gloss; `warm` light; `smoke` that comes and goes; `blood`."""
    smoke: float = 0.0
    """Light that smoke takes, 0..0.95. The share that is lost in the densest puff within 80 mm; `truth/` shows none."""
    mechanics: Literal["none", "pull", "poke", "breathe"] = "none"
    """Motion of an elastic sheet; true stretch. `truth/mechanics.npz` holds it. The sheet is pulled, poked, or spread
    by breathing, in place of the usual motion."""
    gain: Literal["fixed", "auto"] = "fixed"
    """`auto`: exposure follows brightness with a lag; truth/tissue keeps the first one."""
    camera: Literal["still", "inspect"] = "still"
    """`inspect`: the camera moves; every 300 frames or so it pans, turns, rolls, retreats, approaches and returns."""
    border: Literal["none", "octagon", "oval", "rounded"] = "none"
    """Black border around the image; `truth/border.npy` says where."""
    overlay: bool = False
    """Draw the moving red box of a detection with text into most frames; `truth/overlay/` says where."""
    stereo: bool = False
    """Also write the images of the right camera (`right/`) and `calibration.json`."""
    side_views: bool = True
    """Also write what cameras beside the endoscope see of the tissue in test frames (`truth/side/`)."""
    baseline_mm: float = 4.2
    """Distance between the cameras, mm, 0.5..10. The error of `depth/` depends on it."""
    focal_per_width: float = 0.9
    """Focal length divided by image width, 0.5..1.4."""
    principal_x: float | None = None
    """Principal point x, px; None for the image center."""
    principal_y: float | None = None
    """Principal point y, px; None for the image center."""
    frames_per_second: float = 15.0
    """Frame rate in `sequence.json`. One breath always takes 40 frames."""
    breathing_mm: float = 3.0
    """Peak-to-peak breathing motion of the tissue, mm, 0..8."""
    pull_mm: float = 12.0
    """Distance by which the grasper pulls the tissue, mm, 0..30. Beyond 15 mm the pull is also wider. With `mechanics`
    pulled or poked, 0..12."""
    slide_mm: float = 0.0
    """Distance the tissue slides to each side, mm: its rim leaves and returns. 0..12, less with a narrow view."""
    smooth_share: float = 0.0
    """Share of the tissue with hardly any texture, in patches, 0..0.9."""
    noise: float = 1.6
    """Standard deviation of the sensor noise at mid gray, in 8-bit levels, 0..20."""
    depth_noise_px: float = 0.16
    """Standard deviation of the disparity error of `depth/`, in px of a 640 px wide image, 0..2."""
    events: str = ""
    """What disturbs frames: `blur:10-14,white-out:20-22,out-of-body:30-40,cut:45`, see `truth/scene.json`."""
    tracks: int = 256
    """Number of material points in `truth/tracks.npz`, 1..20000."""

    def __post_init__(self) -> None:
        for name, low, high in (
            ("frames", 2, 10000),
            ("width", 32, 4096),
            ("height", 32, 4096),
            ("seed", 0, 2**31 - 1),
            ("baseline_mm", 0.5, 10),
            ("focal_per_width", 0.5, 1.4),
            ("frames_per_second", 0.1, 1000),
            ("breathing_mm", 0, 8),
            ("pull_mm", 0, 30),
            # The material reaches beyond the image by a share of its width: a narrow view has less of it.
            ("slide_mm", 0, min(12, 10.8 / self.focal_per_width) if self.focal_per_width > 0 else 12),
            ("smooth_share", 0, 0.9),
            ("smoke", 0, 0.95),
            ("noise", 0, 20),
            ("depth_noise_px", 0, 2),
            ("tracks", 1, 20000),
        ):
            _require(name, getattr(self, name), low, high)
        for name, hint in get_type_hints(PhantomConfig).items():
            if get_origin(hint) is Literal and getattr(self, name) not in (known := get_args(hint)):
                typed = str(getattr(self, name))
                fix = or_did_you_mean("Choose one of these.", typed, known)
                raise input_error(name, f"one of {', '.join(known)}", repr(typed), fix)
        parse_events(self.events, self.frames)
        if self.scene != "cavity":
            kept = ("scene", "frames", "width", "height", "seed", "baseline_mm", "focal_per_width", "principal_x")
            kept += ("principal_y", "frames_per_second", "noise", "depth_noise_px", "tracks", "border")
            others = tuple(field.name for field in fields(self) if field.name not in kept)
            self._require_default(others, f"--scene {self.scene}", "which belongs to `cavity`")
        if self.mechanics != "none":
            unused = ("breathing_mm",) if self.mechanics != "breathe" else ("pull_mm",)
            self._require_default(("slide_mm", *unused), f"--mechanics {self.mechanics}", "which it has no use for")
            _require("pull_mm with --mechanics", self.pull_mm, 0, MAX_MECHANICS_MM)
        moves = self.camera == "inspect"
        share = MOVING_SHARE if moves else 1
        if self.width * self.height * share > MAX_PIXELS:
            needed = self.width * self.height * share * GB_PER_PIXEL
            got = f"{self.width}x{self.height}, which needs about {needed:.0f} GB"
            allowed = "at most 1920x1080 px in all with a moving camera" if moves else "at most 3840x2160 px in all"
            raise input_error("width, height", allowed, got, "Choose a smaller size.")
        if moves:
            # A wide view of the tilted tissue would reach its horizon when it turns.
            longest = max(self.width, self.height)
            _require("focal length with --camera inspect, / longer side", self.focal / longest, WIDEST_MOVING, 1.4)
        _require("width / height", self.width / self.height, 0.6, 2.0)
        # With a principal point far off center, the image would extend beyond the modeled tissue.
        _require("principal_x", self.center[0], 0.35 * self.width, 0.65 * self.width)
        _require("principal_y", self.center[1], 0.35 * self.height, 0.65 * self.height)

    def _require_default(self, names: tuple[str, ...], given: str, why: str) -> None:
        """Raise InputError if one of these options is set, `why` it is not taken with what is `given`."""
        for field in fields(self):
            if field.name in names and getattr(self, field.name) != field.default:
                option = "--" + field.name.replace("_", "-")
                raise input_error(given, f"no {option}, {why}", "one", f"Remove {option}.")

    @property
    def has_regions(self) -> bool:
        """Whether tracks say which region they are in; without these options, files are those of earlier versions."""
        return self.slide_mm > 0 or self.smooth_share > 0 or self.pull_mm > NARROW_PULL_MM

    @property
    def has_kinds(self) -> bool:
        """Whether what is shown is other than the default; without, files are those of earlier versions."""
        others = self.smoke > 0 or self.gain == "auto" or bool(self.events)
        return self.instruments != "graspers" or self.tissue != "bowel" or others

    @property
    def focal(self) -> float:
        """fx = fy, px."""
        return self.focal_per_width * self.width

    @property
    def center(self) -> tuple[float, float]:
        """Principal point (cx, cy), px."""
        x = self.width / 2 if self.principal_x is None else self.principal_x
        y = self.height / 2 if self.principal_y is None else self.principal_y
        return float(x), float(y)
