"""OpenUSD: the moving Gaussians, the moving surface and the camera of each frame in one stage, .usdz or .usdc.

Source: the schemas UsdVolParticleField3DGaussianSplat (OpenUSD 26.03: linear scales and opacities, harmonics grouped by
particle), UsdGeomMesh, UsdGeomCamera and UsdPreviewSurface, and the specification of usdz packages. The layer is saved
after each time step: what is saved stays in the file, so memory does not grow with the number of time steps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..core.geometry import length_unit
from ..core.shell import install_command
from ..core.types import Camera, Splats
from ..model.carry import carry_points
from ..model.scene import Scene
from ..render.constants import NEAR_Z
from ..render.sh import degree_of
from ..system.atomic import temporary_sibling, whole_file
from .axes import points_in_axes
from .formats import Axes, ExportFormat, ExportOptions, Progress
from .gltf import decoded_srgb
from .mesh import SURFACE_OPTIONS, Mesh, surface_mesh
from .ply import unit_quaternions
from .time_steps import TimeStep, seconds_of_motion, selected_time_steps

AXES: Axes = "opengl"
"""Right, up, back: the axes of USD's cameras, and of a stage whose up axis is Y."""
ROOT = "/tissue"
METERS_PER_UNIT = 0.001
APERTURE = 36.0
"""Width of the film of the cameras, in tenths of a unit; only its ratio to the focal length has a meaning."""
FAR_Z = 1e4
"""The cameras see so far, mm."""
EXTENT_SIGMAS = 3.0
STEPS_AT_ONCE = 8
"""Time steps for which the mesh is carried in one go."""


def write(scene: Scene, out: Path, options: ExportOptions, progress: Progress) -> None:
    """Write the stage.

    Raises:
        InputError: usd-core is missing, the time steps do not increase, or the first shows no surface.
    """
    try:
        import_module("pxr")
    except ImportError:
        raise input_error(out, "the usd-core package", "none", f"`{install_command('usd')}`.") from None
    steps = selected_time_steps(scene, options)
    if len(steps) > 1:
        seconds_of_motion(scene, steps)  # they must increase
    mesh = surface_mesh(scene, steps[0], options)
    with whole_file(out) as temporary:
        if out.suffix == ".usdc":
            _write_layer(scene, steps, mesh, temporary, progress)
            return
        layer = temporary_sibling(out.with_suffix(".usdc"))
        try:
            _write_layer(scene, steps, mesh, layer, progress)
            package = _pxr("Sdf")[0].ZipFileWriter.CreateNew(str(temporary))
            package.AddFile(str(layer), f"{ROOT[1:]}.usdc")
            package.Save()
        finally:
            with suppress(PermissionError):  # Windows keeps a file that a failed writer left open
                layer.unlink(missing_ok=True)


def _write_layer(scene: Scene, steps: list[TimeStep], mesh: Mesh, file: Path, progress: Progress) -> None:
    """Write all prims to a .usdc file. A time code is the index of a frame."""
    Usd, UsdGeom = _pxr("Usd", "UsdGeom")

    stage = Usd.Stage.CreateNew(str(file))
    codes = [step.time * len(scene.cameras) if step.frame is None else step.frame for step in steps]
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, METERS_PER_UNIT)
    stage.SetTimeCodesPerSecond(scene.frames_per_second)
    stage.SetFramesPerSecond(scene.frames_per_second)
    stage.SetStartTimeCode(codes[0])
    stage.SetEndTimeCode(codes[-1])
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, ROOT).GetPrim())
    relative = scene.lengths_are_relative
    about = {"generator": "endoprior", "unit": length_unit(relative), "lengths_are_relative": relative}
    stage.GetRootLayer().customLayerData = about
    degree = scene.config.schedule.sh_degree
    writers = [_gaussians(stage, degree), _camera(stage), _surface(stage, mesh)]
    for k, (step, code, vertices) in enumerate(zip(steps, codes, _carried(scene, steps, mesh), strict=True), 1):
        values = step.plain_splats(scene, AXES), step.camera(scene), points_in_axes(vertices, AXES)
        for put, value in zip(writers, values, strict=True):
            if k == 1:
                put(value, Usd.TimeCode.Default())  # what programs get that ask for no time
            put(value, code)
        stage.GetRootLayer().Save()
        progress(k, len(steps))


def _carried(scene: Scene, steps: list[TimeStep], mesh: Mesh) -> Iterator[NDArray[np.float32]]:
    """(V, 3) vertices of the mesh of the first time step at each of them, world axes, mm."""
    at_first = np.zeros(len(mesh.vertices), np.intp)
    for start in range(0, len(steps), STEPS_AT_ONCE):
        times = [step.time for step in (steps[0], *steps[start : start + STEPS_AT_ONCE])]
        yield from carry_points(scene, mesh.vertices, at_first, times)[1:]


def _pxr(*names: str) -> list[Any]:
    """Modules of OpenUSD, which has no types."""
    return [import_module(f"pxr.{name}") for name in names]


Put = Callable[[Any, Any], None]
"""Writes a value at a time code."""


def _gaussians(stage: Any, degree: int) -> Put:
    """Define the Gaussians, which then take `Splats`."""
    UsdVol, Vt = _pxr("UsdVol", "Vt")

    field = UsdVol.ParticleField3DGaussianSplat.Define(stage, f"{ROOT}/gaussians")
    field.CreateRadianceSphericalHarmonicsDegreeAttr(degree)
    field.CreateProjectionModeHintAttr("perspective")
    field.CreateSortingModeHintAttr("zDepth")
    means, quats = field.CreatePositionsAttr(), field.CreateOrientationsAttr()
    scales, opacities = field.CreateScalesAttr(), field.CreateOpacitiesAttr()
    sh, extent = field.CreateRadianceSphericalHarmonicsCoefficientsAttr(), field.CreateExtentAttr()

    def put(splats: Splats, code: Any) -> None:
        if degree_of(splats.sh.shape[1]) != degree:
            raise ValueError(f"sh must have degree {degree}; got {degree_of(splats.sh.shape[1])}")
        centers, sizes = splats.means.numpy(), splats.scales.numpy()
        margin = EXTENT_SIGMAS * sizes.max(1, keepdims=True)
        # NumPy's columns become x, y, z, w of a Quatf.
        turned = unit_quaternions(splats.quats.numpy().astype(np.float64))[:, [1, 2, 3, 0]]
        means.Set(Vt.Vec3fArray.FromNumpy(_float32(centers)), code)
        quats.Set(Vt.QuatfArray.FromNumpy(_float32(turned)), code)
        scales.Set(Vt.Vec3fArray.FromNumpy(_float32(sizes)), code)
        opacities.Set(Vt.FloatArray.FromNumpy(_float32(splats.opacities.numpy())), code)
        sh.Set(Vt.Vec3fArray.FromNumpy(_float32(splats.sh.numpy().reshape(-1, 3))), code)
        bounds = np.stack([(centers - margin).min(0), (centers + margin).max(0)])
        extent.Set(Vt.Vec3fArray.FromNumpy(_float32(bounds)), code)

    return put


def _camera(stage: Any) -> Put:
    """Define the camera, which then takes that of each frame."""
    Gf, UsdGeom = _pxr("Gf", "UsdGeom")

    camera = UsdGeom.Camera.Define(stage, f"{ROOT}/endoscope")
    camera.CreateClippingRangeAttr(Gf.Vec2f(NEAR_Z, FAR_Z))
    camera.CreateHorizontalApertureAttr(APERTURE)
    pose, focal = camera.AddTransformOp(), camera.CreateFocalLengthAttr()
    height = camera.CreateVerticalApertureAttr()
    right, up = camera.CreateHorizontalApertureOffsetAttr(), camera.CreateVerticalApertureOffsetAttr()

    def put(seen: Camera, code: Any) -> None:
        # Rows, as USD multiplies vectors from the left: right, up, back and the position.
        rows = np.eye(4)
        rows[:3, :3] = points_in_axes(seen.world_to_camera[:3, :3], AXES) * [[1], [-1], [-1]]
        rows[3, :3] = points_in_axes(seen.center, AXES)
        pose.Set(Gf.Matrix4d(*rows.ravel().tolist()), code)
        length = APERTURE * seen.fx / seen.width
        tall = length * seen.height / seen.fy
        focal.Set(length, code)
        height.Set(tall, code)
        right.Set(APERTURE * (0.5 - seen.cx / seen.width), code)
        up.Set(tall * (seen.cy / seen.height - 0.5), code)

    return put


def _surface(stage: Any, mesh: Mesh) -> Put:
    """Define the surface in the colors of the video, not lit again; it then takes (V, 3) vertices."""
    Sdf, UsdGeom, UsdShade, Vt = _pxr("Sdf", "UsdGeom", "UsdShade", "Vt")

    surface = UsdGeom.Mesh.Define(stage, f"{ROOT}/surface")
    surface.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    surface.CreateDoubleSidedAttr(True)
    surface.CreateFaceVertexCountsAttr(Vt.IntArray(len(mesh.triangles), 3))
    surface.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(mesh.triangles.astype(np.int32).ravel()))
    color = surface.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex)
    color.Set(Vt.Vec3fArray.FromNumpy(_float32(decoded_srgb(mesh.colors / 255))))  # linear, as USD has colors
    material = UsdShade.Material.Define(stage, f"{ROOT}/video")
    shader = UsdShade.Shader.Define(stage, f"{ROOT}/video/emission")
    reader = UsdShade.Shader.Define(stage, f"{ROOT}/video/color")
    reader.CreateIdAttr("UsdPrimvarReader_float3")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("displayColor")
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("emissiveColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(
        reader.CreateOutput("result", Sdf.ValueTypeNames.Float3)
    )
    shader.CreateInput("useSpecularWorkflow", Sdf.ValueTypeNames.Int).Set(1)
    for name in ("diffuseColor", "specularColor"):
        shader.CreateInput(name, Sdf.ValueTypeNames.Color3f).Set((0, 0, 0))
    material.CreateSurfaceOutput().ConnectToSource(shader.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    UsdShade.MaterialBindingAPI.Apply(surface.GetPrim()).Bind(material)
    points, extent = surface.CreatePointsAttr(), surface.CreateExtentAttr()

    def put(vertices: NDArray, code: Any) -> None:
        points.Set(Vt.Vec3fArray.FromNumpy(_float32(vertices)), code)
        extent.Set(Vt.Vec3fArray.FromNumpy(_float32(np.stack([vertices.min(0), vertices.max(0)]))), code)

    return put


def _float32(values: NDArray) -> NDArray[np.float32]:
    return np.ascontiguousarray(values, np.float32)


def how_to_see(_scene: Scene, _out: Path, _options: ExportOptions) -> str:
    """What shows the Gaussians."""
    return (
        f"programs with OpenUSD 26.03 or newer show the Gaussians: hide {ROOT}/surface there. Others show that alone."
    )


FORMAT = ExportFormat(
    suffixes=(".usdz", ".usdc"),
    options=("times", "split", *SURFACE_OPTIONS),
    write=write,
    holds="moving Gaussians, their surface and the camera",
    note=how_to_see,
)
