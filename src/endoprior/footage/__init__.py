"""What images of a clip show, measured by pure functions: borders, labels, motion, changes, units."""
