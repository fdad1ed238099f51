"""The scene: canonical Gaussians, how they deform over time, and rendering them at any time from any viewpoint."""
