"""What the synthetic sequence is made of: size, motion, noise. The fields are the options of `endoprior phantom`."""

from __future__ import annotations

from dataclasses import dataclass

from ..core.checks import InputError

MOST_PIXELS = 3840 * 2160
GB_PER_PIXEL = 1.3e-6
"""Memory that writing takes, measured at 1920x1080."""


def _require(name: str, value: float, low: float, high: float) -> None:
    """Raise InputError unless low <= value <= high (NaN fails)."""
    if not low <= value <= high:
        raise InputError(f"`{name}`: expected a value in [{low:g}, {high:g}]; got {value!r}. Choose one in that range.")


@dataclass(frozen=True)
class PhantomConfig:
    """A synthetic operation: breathing bowel under a liver edge, a grasper that pulls it, a second tool that hovers."""

    frames: int = 48
    """Number of frames, 2..10000; the tool grasps, pulls and releases about once every 48 of them."""
    width: int = 640
    """Image width, 32..4096 px; width x height at most 3840 x 2160, which takes 11 GB."""
    height: int = 512
    """Image height, 32..4096 px."""
    seed: int = 0
    """Chooses anatomy, texture, motion and noise; the same seed gives the same bytes."""
    stereo: bool = False
    """Also write what the right eye sees (`right/`) and `calibration.json`."""
    baseline_mm: float = 4.2
    """Distance between the eyes, mm, 0.5..10; also sets how the error of `depth/` grows with distance."""
    focal_per_width: float = 0.9
    """Focal length divided by image width, 0.5..1.4."""
    principal_x: float | None = None
    """Principal point x, px; none means the image center."""
    principal_y: float | None = None
    """Principal point y, px; none means the image center."""
    frames_per_second: float = 15.0
    """Rate written to `sequence.json`; one breath takes 40 frames whatever it is."""
    breathing_mm: float = 3.0
    """Peak to peak motion of the whole field by breathing, mm, 0..8."""
    pull_mm: float = 12.0
    """How far the grasper drags the tissue it holds, mm, 0..15."""
    noise: float = 1.6
    """Standard deviation of the sensor noise at mid gray, in 8-bit levels, 0..20."""
    depth_noise_px: float = 0.16
    """Standard deviation of the disparity error of `depth/`, in px of a 640 px wide image, 0..2."""
    tracks: int = 256
    """Number of material points followed in `truth/tracks.npz`, 1..20000."""

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
            ("pull_mm", 0, 15),
            ("noise", 0, 20),
            ("depth_noise_px", 0, 2),
            ("tracks", 1, 20000),
        ):
            _require(name, getattr(self, name), low, high)
        if self.width * self.height > MOST_PIXELS:
            got = f"{self.width}x{self.height}, which takes about {self.width * self.height * GB_PER_PIXEL:.0f} GB"
            raise InputError(f"`width`, `height`: expected at most 3840x2160 px in all; got {got}. Choose less.")
        _require("width / height", self.width / self.height, 0.6, 2.0)
        # A principal point far off center would look past the modeled tissue.
        _require("principal_x", self.center[0], 0.35 * self.width, 0.65 * self.width)
        _require("principal_y", self.center[1], 0.35 * self.height, 0.65 * self.height)

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
