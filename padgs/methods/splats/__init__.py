"""Explicit Gaussians: the family of 3D Gaussian splatting."""
