"""What the networks are trained for: explain the image (reconstruction, perceptual), keep factors apart."""
