"""EndoSurf as a method: its field and its config."""

from __future__ import annotations

from .radiance.endosurf import EndoSurf
from .radiance.method import RadianceMethod
from .radiance.presets import endosurf

METHOD = RadianceMethod(EndoSurf, endosurf)
