"""Radiance fields: networks that give density or distance and color at any point and time, rendered along rays."""
