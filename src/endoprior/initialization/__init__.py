"""Where Gaussians start: sampled points, their clean-up, and motion fitted to optical flow."""
