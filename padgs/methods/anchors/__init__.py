"""PaD-GS: anchors whose Gaussians are decoded for each view by networks that know the distortion."""
