"""Scorers: each module names its scores in `SCORES` and computes them in `compute(context)`; see `registry`."""
