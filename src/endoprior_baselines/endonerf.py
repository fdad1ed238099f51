"""EndoNeRF as a method: its field and its config."""

from __future__ import annotations

from .radiance.endonerf import EndoNeRF
from .radiance.method import RadianceMethod
from .radiance.presets import endonerf

METHOD = RadianceMethod(EndoNeRF, endonerf)
