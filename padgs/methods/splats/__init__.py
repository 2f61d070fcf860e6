"""Explicit Gaussians with spherical harmonics: the 3DGS family."""
