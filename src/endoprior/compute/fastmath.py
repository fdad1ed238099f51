"""LLVM's fast-math flags of kernels that sum."""

REORDERED = {"reassoc", "contract", "nsz", "arcp", "afn"}
"""Sums may be reordered and products fused, so that loops vectorize; NaN and infinity keep their meaning. Compiled code
still gives the same bits every time."""
