"""Camera models that are learned with explicit Gaussians: SC-OmniGS and Seam360GS."""
