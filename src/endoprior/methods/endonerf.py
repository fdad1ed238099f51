"""EndoNeRF as a method: its field and its config."""

from __future__ import annotations

from ..core.presets_radiance import endonerf
from ..radiance.endonerf import EndoNeRF
from ..training.radiance_method import RadianceMethod

METHOD = RadianceMethod(EndoNeRF, endonerf)
