"""EndoSurf as a method: its field and its config."""

from __future__ import annotations

from ..core.presets_radiance import endosurf
from ..radiance.endosurf import EndoSurf
from ..training.radiance_method import RadianceMethod

METHOD = RadianceMethod(EndoSurf, endosurf)
