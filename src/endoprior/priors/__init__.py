"""Image priors for sampling Gaussians: highlights (`specular`), texture, and their product (`joint`).

NumPy only; every function works on one image.
"""

from .joint import Border, edge_magnitude, joint_texture_prior, salience
from .specular import specular_likelihood

__all__ = ["Border", "edge_magnitude", "joint_texture_prior", "salience", "specular_likelihood"]
