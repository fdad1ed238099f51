"""EndoPrior-GS: from an endoscope video to a moving 3D model of the tissue.

Names are imported when first used, so that `import endoprior` and `endoprior --help` stay fast.
"""

from importlib import import_module
from typing import Any

_HOME = {
    "Config": "core.config",
    "InputError": "core.checks",
    "Scene": "model.scene",
    "evaluate": "evaluation.scoring",
    "joint_texture_prior": "priors",
    "load_scene": "model.scene",
    "load_sequence": "data",
    "preset": "core.presets",
    "train": "runs.training_run",
}

__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'endoprior' has no attribute {name!r}")
    value = getattr(import_module(f".{_HOME[name]}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
