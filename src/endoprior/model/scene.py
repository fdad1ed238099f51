"""A trained scene: canonical Gaussians, how they move, and the cameras that saw them. Look at it, save it, load it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .. import render
from ..arrays_file import load_arrays, part, save_arrays
from ..checks import InputError
from ..config import Config
from ..config_io import from_dict, to_dict
from ..types import Camera, RenderOutput, Splats
from .basis import basis_offsets
from .deformation import HexPlaneField, Offsets
from .gaussians import Gaussians

FORMAT = "endoprior-scene-1"
"""Name and version of the file format, in the file's metadata."""


def offsets_at(
    gaussians: Gaussians, field: HexPlaneField | None, time: float, cfg: Config, chosen: Tensor | None = None
) -> Offsets:
    """Deformation of the Gaussians (of the `chosen` (P,) ones only, if given) at `time` in [0, 1].

    Unless some are chosen, the gradient of temporal coefficients goes to `gaussians.motion_gradients`.
    """
    rows = slice(None) if chosen is None else chosen
    if field is not None:
        return field.offsets(gaussians["means"][rows], time)
    sink = gaussians.motion_gradients if chosen is None else None
    return basis_offsets(gaussians["motion"][rows], time, cfg.deformation, sink)


@dataclass(frozen=True)
class Scene:
    """Everything needed to draw the tissue at any time from anywhere."""

    gaussians: Gaussians
    field: HexPlaneField | None
    """The HexPlane deformation; None when the Gaussians carry temporal coefficients."""
    config: Config
    cameras: tuple[Camera, ...]
    """Camera of each frame of the sequence; frame i was taken at time i / T."""
    frames_per_second: float
    prior_score: Tensor
    """(N,) texture-prior score of each Gaussian."""
    num_valid: Tensor
    """(N,) projections that score was averaged over."""
    lengths_are_relative: bool = False
    """Whether the scale of the sequence's depth was assumed: then what is called mm is not mm."""

    def __len__(self) -> int:
        return len(self.gaussians)

    @torch.no_grad()
    def at(self, time: float) -> Splats:
        """The Gaussians at `time`, activated: means, quats, scales, opacities, sh.

        Raises:
            ValueError: time is not in [0, 1].
        """
        if not 0 <= time <= 1:
            raise ValueError(f"time must be in [0, 1]; got {time!r}. Frame i of T is at time i / T.")
        return self._splats(offsets_at(self.gaussians, self.field, time, self.config))

    @torch.no_grad()
    def canonical(self) -> Splats:
        """The Gaussians as they are stored, before any motion, activated."""
        return self._splats(None)

    def _splats(self, offsets: Offsets | None) -> Splats:
        found = self.gaussians.splats(offsets, self.config.schedule.sh_degree)
        # What no deformation touches is the trained tensor itself, and tied to its gradient.
        return Splats(**{name: value.detach() for name, value in vars(found).items()})

    @torch.no_grad()
    def render(self, time: float, camera: Camera | None = None) -> RenderOutput:
        """Draw the scene at `time` in [0, 1], from `camera` or else the camera of the frame nearest in time.

        Returns:
            color (H, W, 3), depth (H, W) mm as the sum of weight * z, alpha (H, W).
        """
        rasterize = render.load(self.config.render.backend)
        return rasterize(self.at(time), camera or self.camera_at(time), background=torch.zeros(3))

    def camera_at(self, time: float) -> Camera:
        """Camera of the frame nearest in time."""
        return self.cameras[min(round(time * len(self.cameras)), len(self.cameras) - 1)]

    def save(self, path: Path) -> None:
        """Write the scene as one safetensors file, whole or not at all."""
        intrinsics, poses = _camera_arrays(self.cameras)
        arrays = {f"gaussians.{name}": value.detach() for name, value in self.gaussians.tensors.items()}
        arrays |= {"prior_score": self.prior_score, "num_valid": self.num_valid}
        arrays |= {"camera.intrinsics": torch.from_numpy(intrinsics), "camera.world_to_camera": torch.from_numpy(poses)}
        if self.field is not None:
            arrays |= {f"field.{name}": value for name, value in self.field.state_arrays().items()}
        first = self.cameras[0]
        about = {"config": to_dict(self.config), "frames_per_second": self.frames_per_second}
        about |= {"lengths_are_relative": self.lengths_are_relative}
        about |= {"width": first.width, "height": first.height}
        save_arrays(path, arrays, about, FORMAT)


def load_scene(path: str | Path) -> Scene:
    """Read a scene from a run folder or from the path of `scene.safetensors` itself.

    Raises:
        InputError: there is no such file, or it is not a scene this version can read.
    """
    path = Path(path)
    file = path / "scene.safetensors" if path.is_dir() else path
    if not file.is_file():
        raise InputError(f"{file}: expected a trained scene; found none. Train one with `endoprior train DATA {path}`.")
    arrays, about = load_arrays(file, FORMAT, "Train the scene again.")
    try:
        return _from_arrays(arrays, about, str(file))
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{file}: expected every array of a scene; {error!r}. Train the scene again.") from error


def _from_arrays(arrays: dict[str, Tensor], about: dict, where: str) -> Scene:
    cfg = from_dict(Config, about["config"], f"{where}: config")
    gaussians = Gaussians(part(arrays, "gaussians."))
    field = None
    if cfg.deformation.kind == "hexplane":
        field = HexPlaneField(torch.tensor([[1.0] * 3, [0.0] * 3]), cfg.deformation, torch.Generator())
        field.load_state_arrays(part(arrays, "field."))
    intrinsics, poses = arrays["camera.intrinsics"].numpy(), arrays["camera.world_to_camera"].numpy()
    cameras = tuple(
        Camera(about["width"], about["height"], *map(float, k), pose) for k, pose in zip(intrinsics, poses, strict=True)
    )
    rate, relative = about["frames_per_second"], bool(about.get("lengths_are_relative", False))
    return Scene(gaussians, field, cfg, cameras, rate, arrays["prior_score"], arrays["num_valid"], relative)


def _camera_arrays(cameras: tuple[Camera, ...]) -> tuple[NDArray, NDArray]:
    intrinsics = np.array([[c.fx, c.fy, c.cx, c.cy] for c in cameras])
    return intrinsics, np.stack([c.world_to_camera for c in cameras])
