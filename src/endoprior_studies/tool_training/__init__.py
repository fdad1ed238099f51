"""Train the network that finds tools: on real and procedural tissue, with painted instruments, through a camera."""
