"""EgoNeRF (Choi et al., CVPR 2023): a radiance field on spherical grids around the mean place of the cameras.

All lengths in here are in units of the model, and positions are relative to its centre; `model.EgoNeRF` knows both.
"""
