"""The rasterizers, one file each: torch is the definition, the others must match it."""
