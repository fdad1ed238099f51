"""The numbers every backend shares: what is culled, what is visible, when a pixel is full.

They are those of 3D Gaussian splatting (Kerbl et al. 2023) and of EndoGaussian's rasterizer. Numba does not notice a
change here: delete `render/numba/__pycache__` after one.
"""

from __future__ import annotations

NEAR_Z = 0.2
"""A Gaussian whose center has camera z <= this is culled, mm."""
BLUR_PX2 = 0.3
"""Added to both diagonal entries of the projected covariance, px^2, so that nothing is thinner than a pixel."""
JACOBIAN_MARGIN = 0.3
"""The perspective Jacobian is evaluated at most this fraction of tan(field of view / 2) outside the image."""
ALPHA_MAX = 0.99
"""Largest alpha of one Gaussian at one pixel; no gradient flows where it binds."""
ALPHA_MIN = 1.0 / 255.0
"""Smaller alphas count as 0: this is the exact edge of a Gaussian's footprint."""
STOP_TRANSMITTANCE = 1e-4
"""The Gaussian that would bring a pixel's transmittance below this is left out there, and all behind it."""
MIN_QUAT = 1e-12
"""A Gaussian whose quaternion is shorter is culled: its gradient, which grows with 1 / length, would overflow."""
OVERFLOW = 3.4e38
"""A Gaussian is culled when one of its projected numbers reaches this, the end of float32."""
