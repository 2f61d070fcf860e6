"""What Hydra is told, and many runs at once: sweeps, jobs, and looking on."""
