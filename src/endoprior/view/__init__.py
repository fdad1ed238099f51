"""Looking at a scene or a sequence in a web browser. `server` is the one place that acts; everything else is pure."""
