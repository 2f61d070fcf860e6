"""padgs_plus, the method of this project: explicit Gaussians that know the sphere in every part."""
