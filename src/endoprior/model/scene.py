"""A trained scene of Gaussians: the tissue at any time, from any viewpoint.

A scene consists of windows: spans of frames with Gaussians of their own. Most scenes have one (`SingleScene`); a long
sequence of a moving camera has several (`WindowedScene`), and where two overlap, one fades into the other.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, reduce
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from .. import render
from ..compute.parallel_kernels import demand_unforked
from ..core.config import Config
from ..core.geometry import share_of_right
from ..core.types import Camera, Fingerprints, RenderedView, Splats
from ..system.arrays_file import part, save_arrays
from .gaussians import Gaussians, Offsets
from .method import SceneKind, method_of
from .motion import Field, Motion
from .ops import ops_for
from .photometric import between, is_possible
from .rendered_scene import RenderedScene, check_camera, no_gaussians
from .scene_facts import MAX_STORED_GAUSSIANS, SCENE_FORMAT, SceneFacts, camera_arrays, demand, scene_facts

Background = tuple[float, float, float]
"""Color in [0, 1]."""


@dataclass(frozen=True)
class Window:
    """A span of frames with Gaussians of its own."""

    start: int  # its first frame, counted over the sequence
    stop: int  # the frame after its last one
    load: Callable[[], SingleScene]  # gives its scene, which may be read from a file then

    @property
    def scene(self) -> SingleScene:
        """Its Gaussians; times of this scene count from `start`."""
        return self.load()


@dataclass(frozen=True)
class Shown:
    """A window that a scene shows at some time."""

    window: Window
    time: float  # that time in the window's own scene, in [0, 1]
    weight: float  # in (0, 1]: 1 unless two windows overlap there; they add up to 1


class Scene(RenderedScene):
    """A scene of Gaussians."""

    rendered_by: render.Backend | None
    """Rendering backend; None: the one it was trained with, where it can be used."""

    @property
    @abstractmethod
    def windows(self) -> Sequence[Window]:
        """Its windows, in order; a window overlaps the next one only."""

    @abstractmethod
    def __len__(self) -> int:
        """Number of Gaussians in all windows."""

    @abstractmethod
    def changed(self, change: Callable[[SingleScene, Window], SingleScene]) -> Scene:
        """A scene whose windows are what `change` makes of the scene of each; possibly only when they are shown."""

    def shown_at(self, time: float) -> list[Shown]:
        """The windows that the scene shows at `time`: one, or the two that overlap there.

        Raises:
            ValueError: time is not in [0, 1].
        """
        self.check_time(time)
        position, windows = time * len(self.cameras), self.windows
        last = max(k for k, window in enumerate(windows) if window.start <= position or k == 0)
        weight = 1.0
        if last > 0:
            overlap = max(windows[last - 1].stop - windows[last].start, 1)
            weight = faded_in((position - windows[last].start + 0.5) / overlap)
        parts = [(windows[last - 1], 1 - weight), (windows[last], weight)] if weight < 1 else [(windows[last], 1.0)]
        return [_shown(window, position, share) for window, share in parts if share > 0]

    @torch.no_grad()
    def parts_at(self, time: float, camera: Camera | None = None) -> list[tuple[Splats, float]]:
        """The Gaussians, activated, of each window that shows at `time` in [0, 1], and its weight; see `at`."""
        return [(part.window.scene.at(part.time, camera), part.weight) for part in self.shown_at(time)]

    def at(self, time: float, camera: Camera | None = None) -> Splats:
        """The Gaussians at `time`, activated. Where two windows show, those of both, each as opaque as its weight.

        Their colors are those that `camera` sees, of scenes trained on both eyes; None: that the left eye sees.

        A ray that passes Gaussians of opacity o keeps the product of 1 - o. The opacities 1 - (1 - o) ** weight make
        that of both windows together the weighted geometric mean of the two. `render` is sharper there: it mixes the
        pictures of the two.

        Raises:
            ValueError: time is not in [0, 1].
        """
        return joined([faded(splats, weight) for splats, weight in self.parts_at(time, camera)])

    @torch.no_grad()
    def render(self, time: float, camera: Camera | None = None) -> RenderedView:
        """See `RenderedScene.render`; where two windows show, the weighted mean of the pictures of both."""
        check_camera(camera)
        seen_by = camera or self.camera_at(time)
        return render_parts(self.parts_at(time, seen_by), seen_by, self.backend, self.background)

    def window_at(self, frame: int) -> tuple[SingleScene, int]:
        """The scene that shows most of a frame, and the position of that frame in it."""
        part = max(self.shown_at(self.frame_time(frame)), key=lambda shown: shown.weight)
        return part.window.scene, frame - part.window.start

    def smoke_at(self, time: float) -> Tensor | None:
        """See `RenderedScene.smoke_at`."""
        found = [(part.window.scene.smoke, part) for part in self.shown_at(time)]
        grids = [(between(smoke, part.time * len(smoke)), part.weight) for smoke, part in found if smoke is not None]
        if not grids:
            return None
        weights = torch.tensor([weight for _, weight in grids])  # a window without smoke was not asked
        return torch.einsum("k,kijc->ijc", weights / weights.sum(), torch.stack([grid for grid, _ in grids]).cpu())

    @torch.no_grad()
    def render_many(self, times: list[float], cameras: list[Camera]) -> list[RenderedView]:
        """`render` at several times, in one call where the backend can, of cameras of one size: faster on a GPU."""
        parts = [self.parts_at(time, camera) for time, camera in zip(times, cameras, strict=True)]
        return render_parts_many(parts, cameras, self.backend, self.background)

    @cached_property
    def method(self) -> SceneKind:
        """The method that trained it."""
        return method_of(self.config)

    @property
    def background(self) -> Background:
        """Color behind everything: that of its method."""
        return self.method.background

    @property
    def backend(self) -> render.Backend:
        """Rendering backend: `rendered_by`, else the one of the config, if it works on the scene's device."""
        on_gpu = self.device.type != "cpu"
        for backend in (self.rendered_by, self.config.render.backend):
            if backend is not None and (backend in render.ON_GPU) == on_gpu:
                return backend
        return "gsplat" if on_gpu else "numba"


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
    trained_on: Fingerprints | None = None

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
        self.check_time(time)
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
            rendered_by=backend or self.rendered_by,
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
            ("gaussians", num <= MAX_STORED_GAUSSIANS, f"at most {MAX_STORED_GAUSSIANS:,} Gaussians"),
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
            trained_on=facts.trained_on,
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


def with_gaussians(scene: RenderedScene, subject: Path | str = "scene") -> Scene:
    """The scene; InputError, which names `subject`, if it is a radiance field."""
    if not isinstance(scene, Scene):
        raise no_gaussians(scene, subject)
    return scene


def faded_in(place: float) -> float:
    """Weight, 0 to 1, of the later of two windows at a `place` in their overlap, in [0, 1].

    It grows in the middle half only: a window is worse near its ends, which see motion from one side (docs/log.md).
    """
    return min(max(2 * place - 0.5, 0.0), 1.0)


def _shown(window: Window, position: float, weight: float) -> Shown:
    """Args: position: in frames from the start of the sequence."""
    length = window.stop - window.start
    return Shown(window, min(max((position - window.start) / length, 0.0), 1.0), weight)


def render_parts(
    parts: Sequence[tuple[Splats, float]], camera: Camera, backend: render.Backend, background: Background
) -> RenderedView:
    """The weighted mean of what `camera` sees of each of some Gaussians."""
    rasterize, behind = render.load(backend), parts[0][0].means.new_tensor(background)
    return mixed([(rasterize(splats, camera, background=behind).view, weight) for splats, weight in parts])


def render_parts_many(
    parts: Sequence[Sequence[tuple[Splats, float]]],
    cameras: Sequence[Camera],
    backend: render.Backend,
    background: Background,
) -> list[RenderedView]:
    """`render_parts` for several cameras, in one call where the backend can."""
    every = [(splats, camera) for some, camera in zip(parts, cameras, strict=True) for splats, _ in some]
    behind = every[0][0].means.new_tensor(background)
    outputs = render.load_many(backend)([s for s, _ in every], [camera for _, camera in every], background=behind)
    views = iter(out.view for out in outputs)
    return [mixed([(next(views), weight) for _, weight in some]) for some in parts]


def mixed(views: Sequence[tuple[RenderedView, float]]) -> RenderedView:
    """The weighted mean of pictures of one size; the weights add up to 1."""
    if len(views) == 1:
        return views[0][0]
    names = [field.name for field in fields(RenderedView)]
    parts = ([weight * getattr(view, name) for view, weight in views] for name in names)
    return RenderedView(*(reduce(torch.add, part) for part in parts))


def faded(splats: Splats, weight: float) -> Splats:
    """`splats` with their optical depth multiplied by `weight` in (0, 1]."""
    if weight == 1:
        return splats
    return Splats(**splats.tensors | {"opacities": 1 - (1 - splats.opacities) ** weight})


def joined(parts: Sequence[Splats]) -> Splats:
    """The Gaussians of all `parts`, which have the same tensors."""
    if len(parts) == 1:
        return parts[0]
    names = [field.name for field in fields(Splats) if getattr(parts[0], field.name) is not None]
    return Splats(**{name: torch.cat([getattr(part, name) for part in parts]) for name in names})
