"""Readable formulas, as literal as the papers write them: slow, float64 where it matters, and only for tests."""
