"""A scene of one window: Gaussians, how they move, and the cameras that saw them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from .. import render
from ..compute.parallel_kernels import demand_unforked
from ..core.config import Config
from ..core.types import Camera, Splats
from ..footage.stereo_order import share_of_right
from ..system.arrays_file import part, save_arrays
from .gaussians import Gaussians
from .motion import Field, Motion, Offsets
from .ops import ops_for
from .photometric import is_possible
from .scene import Scene, Window
from .scene_facts import MOST_GAUSSIANS, SceneFacts, camera_arrays, demand, scene_facts

SCENE_FORMAT = "endoprior-scene-1"
"""Name and version of the file format, in the file's metadata."""


@dataclass(frozen=True)
class SingleScene(Scene):
    """A scene of one window: canonical Gaussians, their motion and the cameras of the sequence."""

    gaussians: Gaussians
    field: Field | None
    """What they share to move, if the method has such a thing."""
    config: Config
    cameras: tuple[Camera, ...]
    frames_per_second: float
    prior_score: Tensor
    """(N,) texture-prior score of each Gaussian."""
    num_valid: Tensor
    """(N,) projections that score was averaged over."""
    lengths_are_relative: bool = False
    trained_from: float = 0.0
    """Time of the first frame that motion was trained on; before it, motion is what it is then ..."""
    trained_until: float = 1.0
    """... and after this one too: a temporal basis that nothing holds leads anywhere."""
    rendered_by: render.Backend | None = None
    baseline_mm: float = 0.0
    """From the left to the right camera, where both were trained on: what `gloss` is seen from; 0: from nowhere."""
    smoke: Tensor | None = None
    """(T, I, J, 2) gain and veil of each frame: see `photometric`; None: no smoke."""
    tissue: Tensor | None = None
    """(T, I, J) share of each cell of the frame that is tissue, 0..255: see `uncertainty`; None: not known."""
    depth_noise: float = 0.0
    """How far rendered depth is from measured depth, as a share of it; 0: not known."""

    def __len__(self) -> int:
        return len(self.gaussians)

    @property
    def windows(self) -> tuple[Window]:
        """The scene itself is its only window."""
        return (Window(0, len(self.cameras), lambda: self),)

    @torch.no_grad()
    def at(self, time: float, camera: Camera | None = None) -> Splats:
        """See `Scene.at`."""
        demand_unforked()  # torch would wait for threads that are not there, before the first kernel is reached
        if not 0 <= time <= 1:
            raise ValueError(f"time must be in [0, 1]; got {time!r}. Frame i of T is at time i / T.")
        share = 0.0
        if camera is not None and self.baseline_mm:
            share = share_of_right(camera, self.camera_at(time), self.baseline_mm)
        return self._splats(self.offsets(self.gaussians, time), share)

    def parts_at(self, time: float, camera: Camera | None = None) -> list[tuple[Splats, float]]:
        """See `Scene.parts_at`."""
        return [(self.at(time, camera), 1.0)]

    def offsets(self, gaussians: Gaussians, time: float) -> Offsets:
        """Deformation of some Gaussians of the scene at `time` in [0, 1]."""
        held = min(max(time, self.trained_from), self.trained_until)
        return self.motion.offsets(gaussians, self.field, held, self.config, ops_for(self.device))

    @cached_property
    def motion(self) -> Motion:
        """How its Gaussians move."""
        return self.method.motion(self.config)

    @torch.no_grad()
    def canonical(self) -> Splats:
        """The Gaussians as they are stored, before any motion, activated."""
        return self._splats(None)

    def _splats(self, offsets: Offsets | None, right_share: float = 0.0) -> Splats:
        found = self.gaussians.splats(offsets, self.config.schedule.sh_degree, right_share)
        # A tensor that no deformation changes is the trained tensor itself, with its gradient.
        return Splats(**{name: value.detach() for name, value in found.tensors.items()})

    @property
    def device(self) -> torch.device:
        """See `Scene.device`."""
        return self.gaussians["means"].device

    def to(
        self, device: torch.device | str, *, backend: render.Backend | None = None, fp16_planes: bool = False
    ) -> SingleScene:
        """See `Scene.to`."""
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

    def changed(self, change: Callable[[SingleScene, Window], SingleScene]) -> SingleScene:
        """See `Scene.changed`."""
        return change(self, self.windows[0])

    @staticmethod
    def of_arrays(
        arrays: Mapping[str, Tensor], cameras: tuple[Camera, ...], facts: SceneFacts, motion: Motion
    ) -> SingleScene:
        """The scene that `save` wrote as these arrays, which fit its method's `schema`.

        Raises:
            InputError: a value that no scene can have.
        """
        num, quats = len(arrays["gaussians.means"]), arrays["gaussians.quats"]
        demand(
            ("gaussians", num <= MOST_GAUSSIANS, f"at most {MOST_GAUSSIANS:,} Gaussians"),
            ("gaussians.quats", not num or bool((quats.abs().amax(1) >= 1e-12).all()), "no quaternion of length 0"),
            ("num_valid", bool((arrays["num_valid"] >= 0).all()), "counts"),
            ("smoke", "smoke" not in arrays or is_possible(arrays["smoke"]), "gains and veils"),
        )
        return SingleScene(
            Gaussians(part(arrays, "gaussians.")),
            motion.field_of(part(arrays, "field."), facts.config),
            facts.config,
            cameras,
            facts.frames_per_second,
            arrays["prior_score"],
            arrays["num_valid"],
            facts.lengths_are_relative,
            facts.trained_from,
            facts.trained_until,
            baseline_mm=facts.baseline_mm,
            smoke=arrays.get("smoke"),
            tissue=arrays.get("tissue"),
            depth_noise=facts.depth_noise,
        )

    def save(self, path: str | Path) -> None:
        """See `Scene.save`."""
        if self.field is not None and self.field.grid is not None and self.field.grid.values.dtype != torch.float32:
            raise ValueError("save the scene itself, not a copy with fp16 planes")
        arrays = {f"gaussians.{name}": value.detach() for name, value in self.gaussians.tensors.items()}
        arrays |= {"prior_score": self.prior_score, "num_valid": self.num_valid}
        arrays |= camera_arrays(self.cameras)
        if self.field is not None:
            arrays |= {f"field.{name}": value for name, value in self.field.state_arrays().items()}
        about: dict[str, Any] = {"trained_from": self.trained_from, "trained_until": self.trained_until}
        if self.baseline_mm:
            about["baseline_mm"] = self.baseline_mm
        if self.smoke is not None:
            arrays["smoke"], about["smoke"] = self.smoke, True
        if self.tissue is not None:
            arrays["tissue"], about["tissue"] = self.tissue, True
        if self.depth_noise:
            about["depth_noise"] = self.depth_noise
        save_arrays(Path(path), arrays, scene_facts(self) | about, SCENE_FORMAT)
