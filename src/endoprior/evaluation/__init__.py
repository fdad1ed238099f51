"""Scores of a scene: image, depth, flow and track metrics, and the protocol they are printed with."""
