"""The geometry of panoramas: directions, angles, pixels, cameras, the distortion map, and functions on the sphere."""
