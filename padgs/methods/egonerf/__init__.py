"""EgoNeRF (Choi et al. 2023): a radiance field on spherical grids, rendered by sampling rays."""
