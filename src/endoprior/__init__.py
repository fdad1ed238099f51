"""EndoPrior-GS: from an endoscope video to a moving 3D model of the tissue.

Names are imported when first used, so that `import endoprior` and `endoprior --help` stay fast.
"""

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

from .system.surroundings import ignore_settings_of_current_folder

if TYPE_CHECKING:
    from .core.checks import InputError
    from .core.config import Config
    from .data import load_sequence
    from .evaluation.scoring import evaluate
    from .model.presets import preset
    from .model.scene import Scene
    from .model.scene_file import load_scene
    from .priors import joint_texture_prior
    from .runs.train import train

# OpenCV reads at its import how many pixels it decodes at most (`data.reading.MOST_PIXELS`): what a header says twice,
# its decoders and the readers of headers may understand differently. A value set by the user stays.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", "64000000")
ignore_settings_of_current_folder()

HOMES = {
    "Config": "core.config",
    "InputError": "core.checks",
    "Scene": "model.scene",
    "evaluate": "evaluation.scoring",
    "joint_texture_prior": "priors",
    "load_scene": "model.scene_file",
    "load_sequence": "data",
    "preset": "model.presets",
    "train": "runs.train",
}
"""Module of each public name. No module or package directly below this one has such a name: it would replace it."""

__all__ = [
    "Config",
    "InputError",
    "Scene",
    "evaluate",
    "joint_texture_prior",
    "load_scene",
    "load_sequence",
    "preset",
    "train",
]


def __getattr__(name: str) -> Any:
    if name not in HOMES:
        raise AttributeError(f"module 'endoprior' has no attribute {name!r}")
    value = getattr(import_module(f".{HOMES[name]}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
