"""The scene: what is static in one synthetic sequence, and what moves, at one time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .camera_path import CameraPath
from .config import PhantomConfig
from .eye import Eye
from .instrument_tracing import Instrument
from .motion import Motion, ToolPose
from .raster import vertex_normals
from .smoke import Smoke
from .surface import Plane
from .tissue_looks import TissueLook


@dataclass(frozen=True)
class Scene:
    """The static parts of one synthetic sequence."""

    cfg: PhantomConfig
    plane: Plane
    motion: Motion
    a: NDArray[np.float64]
    """(MH, MW) plane coordinates of the mesh vertices, mm."""
    b: NDArray[np.float64]
    """(MH, MW) second plane coordinate, mm."""
    height: NDArray[np.float32]
    """(MH, MW) rest height of the vertices, mm."""
    texture: NDArray[np.float32]
    """(TH, TW, 7) material maps."""
    path: CameraPath
    look: TissueLook
    instruments: tuple[Instrument, Instrument] | None
    """None: the pair of `graspers`."""
    smoke: Smoke | None

    def vertices(self, phase: float) -> NDArray[np.float64]:
        """(MH, MW, 3) mesh in world axes, mm, at time `phase` in [0, 1]."""
        moved = self.motion.displacement(self.a, self.b, phase)
        return self.plane.lift(self.a + moved[..., 0], self.b + moved[..., 1], self.height + moved[..., 2])

    def endoscope(self, phase: float) -> Eye:
        """Its left camera in the world at time `phase`."""
        return Eye.posed(self.path.camera_to_world(phase))


@dataclass(frozen=True)
class Moment:
    """What moves, at one time, in the axes of the endoscope's left camera of that time."""

    endoscope: Eye
    """The left camera in the world."""
    vertices: NDArray[np.float64]
    """(MH, MW, 3) mesh, mm."""
    normals: NDArray[np.float32]
    """(MH, MW, 3) its unit normals."""
    tools: tuple[ToolPose, ToolPose]
    """In world axes."""
    phase: float = 0.0
    """Time in [0, 1]."""

    @staticmethod
    def of(scene: Scene, phase: float) -> Moment:
        """The scene at time `phase` in [0, 1]."""
        endoscope = scene.endoscope(phase)
        vertices = endoscope.sees(scene.vertices(phase))
        return Moment(endoscope, vertices, vertex_normals(vertices), scene.motion.tools(phase), phase)
