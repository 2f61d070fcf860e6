"""Trainable models: PaD-GS (anchors), the 3DGS family (splats), padgs+ (plus) and EgoNeRF."""
