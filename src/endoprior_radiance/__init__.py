"""Compared radiance fields, EndoNeRF and EndoSurf, found as plugins: docs/add_a_method.md lists the names they use.

A radiance field is networks that give density or distance and color at any point and time, rendered along rays.
"""
