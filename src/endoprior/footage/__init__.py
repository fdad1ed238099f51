"""Image analysis of a clip, as pure functions: borders, labels, motion, changes, stereo order, masks, depth unit."""
