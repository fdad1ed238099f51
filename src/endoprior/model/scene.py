"""A trained scene: canonical Gaussians, their motion and the cameras of the sequence; rendering, saving, loading."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .. import render
from ..core.checks import InputError, check_range, input_error
from ..core.config import Config
from ..core.config_io import from_dict, to_dict
from ..core.geometry import FARTHEST_MM
from ..core.ranges import Checked, Range
from ..core.shell import command
from ..core.types import Camera, RenderedView, Splats
from ..system.arrays_file import ArraySpec, load_arrays, part, rejecting, save_arrays
from .basis import basis_offsets
from .deformation import HexPlaneField, Offsets
from .gaussians import Gaussians
from .ops import ModelOps, ops_for
from .schema import model_schema

FORMAT = "endoprior-scene-1"
"""Name and version of the file format, in the file's metadata."""
LARGEST_SIDE = 2**16
"""Largest width or height of an image, px."""
LARGEST_IMAGE = 2**26
"""Largest number of pixels of an image: 8192 x 8192."""
MOST_GAUSSIANS, MOST_FRAMES = 10_000_000, 1_000_000
LARGEST_DEVIATION = 5e-3
"""Largest entry of R R^T - I that still passes for a rotation; readers accept 1e-3 of R^T R."""


def offsets_at(
    gaussians: Gaussians,
    field: HexPlaneField | None,
    time: float,
    cfg: Config,
    ops: ModelOps,
    chosen: Tensor | None = None,
) -> Offsets:
    """Deformation of the Gaussians (of the `chosen` (P,) ones only, if given) at `time` in [0, 1].

    Unless some are chosen, the gradient of temporal coefficients goes to `gaussians.motion_gradients`.
    """
    rows = slice(None) if chosen is None else chosen
    if field is not None:
        return field.offsets(gaussians["means"][rows], time, ops)
    sink = gaussians.motion_gradients if chosen is None else None
    return basis_offsets(gaussians["motion"][rows], time, cfg.deformation, ops, sink)


@dataclass(frozen=True)
class Scene:
    """Everything needed to render the tissue at any time from any viewpoint."""

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
    """Whether the scale of the sequence's depth was assumed: lengths are then not in mm."""
    rendered_by: render.Backend | None = None
    """Rendering backend; None: the one it was trained with, where it can be used."""

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
        return self._splats(offsets_at(self.gaussians, self.field, time, self.config, ops_for(self.device)))

    @torch.no_grad()
    def canonical(self) -> Splats:
        """The Gaussians as they are stored, before any motion, activated."""
        return self._splats(None)

    def _splats(self, offsets: Offsets | None) -> Splats:
        found = self.gaussians.splats(offsets, self.config.schedule.sh_degree)
        # A tensor that no deformation changes is the trained tensor itself, with its gradient.
        return Splats(**{name: value.detach() for name, value in found.tensors.items()})

    @torch.no_grad()
    def render(self, time: float, camera: Camera | None = None) -> RenderedView:
        """Render the scene at `time` in [0, 1], from `camera` or else the camera of the frame nearest in time.

        Returns:
            color (H, W, 3) in [0, 1], depth (H, W) mm as the sum of weight * z, alpha (H, W) in [0, 1), and
            unclamped_color (H, W, 3).
        Raises:
            ValueError: time is not in [0, 1].
        """
        splats = self.at(time)
        rasterize = render.load(self.backend)
        return rasterize(splats, camera or self.camera_at(time), background=splats.means.new_zeros(3)).view

    @torch.no_grad()
    def render_many(self, times: list[float], cameras: list[Camera]) -> list[RenderedView]:
        """`render` at several times, one camera each, in one call where the backend can: faster on a GPU.

        Raises:
            ValueError: a time is not in [0, 1], or cameras differ in size where the backend renders them together.
        """
        splats = [self.at(time) for time in times]
        outputs = render.load_many(self.backend)(splats, cameras, background=splats[0].means.new_zeros(3))
        return [out.view for out in outputs]

    @property
    def device(self) -> torch.device:
        """Device that holds the scene and renders it."""
        return self.gaussians["means"].device

    @property
    def backend(self) -> render.Backend:
        """Rendering backend: `rendered_by`, else the one of the config, if it works on the scene's device."""
        on_gpu = self.device.type != "cpu"
        for backend in (self.rendered_by, self.config.render.backend):
            if backend is not None and (backend in render.ON_GPU) == on_gpu:
                return backend
        return "gsplat" if on_gpu else "numba"

    def to(
        self, device: torch.device | str, *, backend: render.Backend | None = None, fp16_planes: bool = False
    ) -> Scene:
        """This scene on a device; itself if it is there.

        Args:
            backend: renders it there; None: the one it was trained with, or gsplat on a GPU.
            fp16_planes: HexPlane in half precision, half the memory and faster: for rendering, cannot be saved.
        """
        gaussians = self.gaussians.to(device)
        field = self.field and self.field.to(device, fp16_planes=fp16_planes)
        if gaussians is self.gaussians and field is self.field and backend in (None, self.rendered_by):
            return self
        return replace(
            self,
            rendered_by=backend,
            gaussians=gaussians,
            field=field,
            prior_score=self.prior_score.to(device),
            num_valid=self.num_valid.to(device),
        )

    def camera_at(self, time: float) -> Camera:
        """Camera of the frame nearest in time."""
        return self.cameras[min(round(time * len(self.cameras)), len(self.cameras) - 1)]

    def save(self, path: Path) -> None:
        """Write the scene as one safetensors file, completely or not at all.

        Raises:
            ValueError: its planes are in half precision.
        """
        if self.field is not None and self.field.grid.values.dtype != torch.float32:
            raise ValueError("save the scene itself, not a copy with fp16 planes")
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
    file = path / "scene.safetensors" if os.path.isdir(path) else path
    if not os.path.isfile(file):  # of a name too long for the system pathlib would raise
        raise input_error(file, "a trained scene", "none", f"`{command('train', 'DATA', path)}`.")
    next_step = "Train the scene again."
    arrays, about = load_arrays(file, FORMAT, scene_schema, next_step)
    with rejecting(file, "a scene", next_step):
        facts = from_dict(SceneFacts, {name: value for name, value in about.items() if name != "format"}, "about")
        check_values(arrays)
        return _from_arrays(arrays, facts)


@dataclass(frozen=True)
class SceneFacts(Checked):
    """Metadata of a scene's file."""

    config: Config
    width: Annotated[int, Range(1, LARGEST_SIDE)]
    height: Annotated[int, Range(1, LARGEST_SIDE)]
    frames_per_second: Annotated[float, Range(1e-3, 1e6)]
    lengths_are_relative: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range("width times height", self.width * self.height, 1, LARGEST_IMAGE)


def scene_schema(about: dict[str, Any]) -> dict[str, ArraySpec]:
    """The arrays of a scene's file of this description; `N` Gaussians, `T` frames."""
    per_gaussian = {name: ArraySpec("float32", ("N",)) for name in ("prior_score", "num_valid")}
    cameras = {
        "camera.intrinsics": ArraySpec("float64", ("T", 4)),
        "camera.world_to_camera": ArraySpec("float64", ("T", 4, 4)),
    }
    return model_schema(from_dict(Config, about["config"])) | per_gaussian | cameras


def check_values(arrays: Mapping[str, Tensor]) -> None:
    """Reject arrays of a scene, finite and of the right shapes, that no scene can have.

    Raises:
        InputError: naming the array.
    """
    num, quats = len(arrays["gaussians.means"]), arrays["gaussians.quats"]
    _demand(
        ("gaussians", num <= MOST_GAUSSIANS, f"at most {MOST_GAUSSIANS:,} Gaussians"),
        ("gaussians.quats", bool((quats.abs().amax(1) >= 1e-12).all()) if num else True, "no quaternion of length 0"),
        ("num_valid", bool((arrays["num_valid"] >= 0).all()), "counts"),
    )
    _check_cameras(arrays["camera.intrinsics"].numpy(), arrays["camera.world_to_camera"].numpy())


def check_cameras(cameras: tuple[Camera, ...]) -> None:
    """Reject cameras with which a saved scene could not be loaded.

    Raises:
        InputError: naming what is wrong with them.
    """
    first = cameras[0]
    _demand(
        ("width and height", max(first.width, first.height) <= LARGEST_SIDE, f"at most {LARGEST_SIDE:,} px"),
        ("width times height", first.width * first.height <= LARGEST_IMAGE, f"at most {LARGEST_IMAGE:,} px"),
    )
    _check_cameras(*_camera_arrays(cameras))


def _check_cameras(intrinsics: NDArray, poses: NDArray) -> None:
    deviation = poses[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1) - np.eye(3)
    rigid = (np.abs(deviation) <= LARGEST_DEVIATION).all((1, 2)) & (np.linalg.det(poses[:, :3, :3]) > 0)
    rigid &= (poses[:, 3] == (0, 0, 0, 1)).all(1) & (np.abs(poses[:, :3, 3]) <= FARTHEST_MM).all(1)
    focal = (intrinsics[:, :2] >= 1e-3) & (intrinsics[:, :2] <= 1e7)
    _demand(
        ("camera.intrinsics", 1 <= len(intrinsics) <= MOST_FRAMES, f"1 to {MOST_FRAMES:,} frames"),
        ("camera.intrinsics", focal.all(), "focal lengths of 0.001 to 1e7 px"),
        ("camera.intrinsics", (np.abs(intrinsics[:, 2:]) <= 1e7).all(), "principal points within 1e7 px"),
        ("camera.world_to_camera", rigid.all(), f"rigid transforms within {FARTHEST_MM:g} mm"),
    )


def _demand(*facts: tuple[str, Any, str]) -> None:
    """Raise InputError at the first (name, whether it is so, what was expected) that is not so."""
    for name, so, expected in facts:
        if not so:
            raise InputError(f"expected {expected} in {name}; got something else.")


def _from_arrays(arrays: dict[str, Tensor], facts: SceneFacts) -> Scene:
    cfg = facts.config
    field = None
    if cfg.deformation.kind == "hexplane":
        field = HexPlaneField.from_state_arrays(part(arrays, "field."), cfg.deformation)
    intrinsics, poses = arrays["camera.intrinsics"].numpy(), arrays["camera.world_to_camera"].numpy()
    cameras = tuple(
        Camera(facts.width, facts.height, *map(float, k), pose) for k, pose in zip(intrinsics, poses, strict=True)
    )
    return Scene(
        Gaussians(part(arrays, "gaussians.")),
        field,
        cfg,
        cameras,
        facts.frames_per_second,
        arrays["prior_score"],
        arrays["num_valid"],
        facts.lengths_are_relative,
    )


def _camera_arrays(cameras: tuple[Camera, ...]) -> tuple[NDArray, NDArray]:
    intrinsics = np.array([[c.fx, c.fy, c.cx, c.cy] for c in cameras])
    return intrinsics, np.stack([c.world_to_camera for c in cameras])
