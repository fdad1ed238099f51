"""Dense depth from a moving camera: plane sweep along its path, confidence, and the guess bent to what is measured."""
