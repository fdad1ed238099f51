"""Where the camera was in each frame."""
