"""padgs_plus, the method of this project: explicit Gaussians without charts, axes or world units."""
