"""EndoPrior-GS: from an endoscope video to a moving 3D model of the tissue.

Names are imported when first used, so that `import endoprior` and `endoprior --help` stay fast. An import changes
nothing of its process: no variable, no setting of another library.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from .core.kernel_folder import without_kernel_cache

if TYPE_CHECKING:
    from .core.checks import InputError
    from .core.config import Config
    from .core.types import Camera, Splats
    from .data import FrameSequence, load_sequence
    from .evaluation.scoring import evaluate
    from .export import export
    from .model.presets import preset
    from .model.scene import Scene
    from .model.scene_file import load_scene
    from .phantom import write_phantom as phantom
    from .prepare import prepare
    from .priors import joint_texture_prior
    from .render.rasterization import rasterize
    from .runs.train import train

    __version__: str

HOMES = {
    "Camera": "core.types",
    "Config": "core.config",
    "FrameSequence": "data",
    "InputError": "core.checks",
    "Scene": "model.scene",
    "Splats": "core.types",
    "evaluate": "evaluation.scoring",
    "export": "export",
    "joint_texture_prior": "priors",
    "load_scene": "model.scene_file",
    "load_sequence": "data",
    "phantom": "phantom",
    "prepare": "prepare",
    "preset": "model.presets",
    "rasterize": "render.rasterization",
    "train": "runs.train",
}
"""Module of each public name. A name that is its own module is a package that can be called
(`core.callable_package`); no other module directly below this one has a public name: it would replace it."""

__all__ = [
    "Camera",
    "Config",
    "FrameSequence",
    "InputError",
    "Scene",
    "Splats",
    "evaluate",
    "export",
    "joint_texture_prior",
    "load_scene",
    "load_sequence",
    "phantom",
    "prepare",
    "preset",
    "rasterize",
    "train",
]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("endoprior")
    if name not in HOMES:
        raise AttributeError(f"module 'endoprior' has no attribute {name!r}")
    try:
        module = import_module(f".{HOMES[name]}", __name__)
        value = module if name == HOMES[name] else getattr(module, name)
    except RuntimeError as error:
        raise without_kernel_cache(error) or error from None
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
