"""The options of `endoprior prepare`: one field each."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from ..core.checks import check_range, input_error
from ..core.geometry import Convention
from .calibration_files import Unit
from .stereo import StereoConfig

Layout = Literal["auto", "mono", "side-by-side", "top-bottom", "interlaced", "two-files"]
NETWORK, SAM2 = "depth-anything", "sam2"
"""Values of --depth and --masks that a folder of weights, or the name of a model, may follow after a colon."""
MOTION, SHADING = "motion", "shading"
"""Values of --depth; the first may be followed by a colon and another one, which fills what motion does not measure."""
METHODS = ("auto", MOTION, "none", "sgbm", SHADING, "still", "auto-own", "estimate", "own", "colmap", NETWORK, SAM2)
"""Values of --depth, --masks and --poses that are no paths."""
Rectangle = tuple[int, int, int, int]  # x, y, width, height in px, in one camera's image of the source video


def parse_rectangle(text: str, option: str) -> Rectangle:
    """`x,y,width,height` in px; InputError if the text has another form."""
    want, fix = "x,y,width,height in px", f"`{option} 0,0,640,500`."
    try:
        x, y, width, height = (int(part) for part in text.split(","))
    except ValueError:
        raise input_error(option, want, repr(text), fix) from None
    if min(x, y) < 0 or min(width, height) < 1:
        raise input_error(option, "x, y >= 0 and width, height >= 1", repr(text), fix)
    return x, y, width, height


def names_path(value: str) -> bool:
    """Whether a value of --depth, --masks or --poses is a file or folder of the user."""
    return value not in METHODS and value.partition(":")[0] not in (NETWORK, SAM2, MOTION)


def is_sam2(value: str) -> bool:
    """Whether a value of `--masks` or `--with` names this segmenter, rather than a folder."""
    return value.partition(":")[0] == SAM2


@dataclass(frozen=True)
class PrepareConfig:
    """Options of `prepare`."""

    right: Path | None = None
    """Video or image folder of the second camera, if each camera has its own file."""
    calibration: Path | None = None
    """Calibration of one or two cameras: a file of OpenCV, ROS, Kalibr, da Vinci, ..."""
    calibration_size: str = ""
    """Size of one camera's image when it was calibrated, such as `1280x1024`, if the file does not state it."""
    calibration_unit: Unit = "auto"
    """Unit of the translation T in the calibration."""
    layout: Layout = "auto"
    """How the images of two cameras are stored in a video frame."""
    swap_eyes: bool = False
    """The first camera of the video is the right one: swap them."""
    squeezed_eyes: bool = False
    """Each camera has half of its width (side by side) or height (top-bottom): stretch its images."""
    row_offset: Literal["no", "auto"] = "no"
    """`auto` measures how many rows apart both cameras see the same point, and moves the right images by that."""
    field_of_view_degrees: float = 70.0
    """Assumed angle across the image width, or across the round border. Used only without a calibration."""

    start: float = 0.0
    """First time to use, seconds."""
    end: float = math.inf
    """End time, seconds; not included. inf is the end of the video."""
    frames_per_second: float = 0.0
    """Frame rate of the output; 0 is the usual rate of the source."""
    folder_rate: float | None = None
    """Frame rate of a folder of images, 1/s; without it that of its sequence.json, else 25."""
    max_frames: int = 10_000
    """Stop with an error above this number of frames; choose a part of the video or a lower rate."""
    drop_out_of_body: bool = False
    """Leave out frames without the color of the inside of a body."""

    crop: str | None = None
    """x,y,width,height in px of one camera's image: keep only this part."""
    blank: tuple[str, ...] = ()
    """x,y,width,height rectangles to paint black and mask, such as patient names that are not found."""
    border: Literal["auto", "keep"] = "auto"
    """`auto`: crop console strips and black bars, mask the outside of a round border, burnt-in text and drawings."""
    max_width: int = 640
    """Resize wider images to this width, px; 0 keeps the size."""

    depth: str = "auto"
    """`sgbm` (stereo), `motion` (parallax of a moving camera), `shading` (one camera, relative), `depth-anything` (a
    network), a folder of depth files, or `none`. `auto` is `sgbm` for two cameras; for one, `motion` where the camera
    moves enough, else `shading`. A colon may follow: after `motion` what fills it where nothing is measured, without it
    `shading`; after `depth-anything` the folder of its weights."""
    depth_unit_mm: float = 0.0
    """mm per unit of the files in a depth folder; required with such a folder unless its depth is relative."""
    depth_relative: Literal["no", "depth", "disparity"] = "no"
    """The depth folder holds relative depth, or relative disparity (near is large), of a network."""
    working_distance_mm: float = 70.0
    """Relative depth is scaled to this median, mm."""
    known_length: tuple[str, ...] = field(default=(), metadata={"metavar": "FRAME,X1,Y1,X2,Y2,MM"})
    """Relative depth gets mm: two points of tissue, x, y in px of the written frame, are MM apart. One or more."""
    shaft_mm: float = field(default=0.0, metadata={"metavar": "MM"})
    """Relative depth gets mm: diameter of all instruments' shafts, most often 8 in robotic surgery, else 5. Their tips
    must touch tissue in some frames. Less sure than --known-length."""
    stereo: StereoConfig = field(default_factory=StereoConfig)

    masks: str = "auto"
    """`auto` (given beside the images, else found), `sam2`, `none`, or a folder of masks."""
    mask_labels: str = ""
    """Labels in the mask folder that are tools: names such as `shaft,jaw`, values such as `1,3`. Usually they tell."""
    mask_tool_value: Literal["auto", "high", "low"] = "auto"
    """Which value marks tools in the mask folder."""

    poses: str = "auto"
    """`still` (static camera), `estimate` (from depth and static tissue; by COLMAP if it is installed and explains the
    frames better; `own` and `colmap` force one), or a file of poses (docs/depth_and_poses.md). `auto` estimates poses
    if the camera moves; `auto-own` never by COLMAP, which takes longer."""
    poses_convention: Convention = "opencv"
    """Meaning of the matrices in the file of --poses: camera-to-world with OpenCV or OpenGL axes, or LLFF's columns
    (down, right, back); or world-to-camera. `check` tells which one fits."""
    poses_unit_mm: float | None = None
    """mm per unit of the positions in the file of --poses: 1000 for m. Without it text is in m, other files in mm."""
    stir: Path | None = None
    """Folder of the STIR clip (`left/seqNN`) that VIDEO belongs to: its tattooed points become `truth/tracks.npz`."""
    keep_right: bool = False
    """Also write the images of the right camera to `right/`."""

    @property
    def initial_depth(self) -> str:
        """How depth is made of single frames: `depth`, or what fills it where motion measures."""
        method, _, filler = self.depth.partition(":")
        return (filler or SHADING) if method == MOTION else self.depth

    @property
    def demands_motion(self) -> bool:
        """Whether depth is to be measured by the motion of the camera, and nothing else will do."""
        return self.depth.partition(":")[0] == MOTION

    def __post_init__(self) -> None:
        if self.stir is not None and self.depth == "none":
            raise ValueError("stir needs depth, got --depth none")
        for name, low, high in (
            ("field_of_view_degrees", 10, 170), ("start", 0, 1e9), ("frames_per_second", 0, 1000),
            ("max_frames", 2, 1_000_000), ("max_width", 0, 16384),
            ("depth_unit_mm", 0, 1e6), ("poses_unit_mm", 1e-6, 1e6), ("working_distance_mm", 1, 1000),
            ("shaft_mm", 0, 1000), ("folder_rate", 0.01, 1000),
        ):  # fmt: skip
            if (value := getattr(self, name)) is not None:
                check_range(name, value, low, high)
        if not self.end > self.start:
            raise ValueError(f"end must be after start, got {self.end:g} and {self.start:g}")
