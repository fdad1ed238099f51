"""Image analysis of a clip, as pure functions: borders, labels, motion, changes, stereo matching, masks, depth unit."""
