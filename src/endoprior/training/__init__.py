"""The training loop, the optimizer, the losses, density control and the divergence check."""
