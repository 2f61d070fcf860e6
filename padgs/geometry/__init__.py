"""Geometry of panoramas: directions, angles, pixels, cameras, distortion map, functions on the sphere."""
