"""Export of trained models to files of explicit Gaussians."""
