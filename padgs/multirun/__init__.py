"""`padgs-run`: single runs and sweeps, composed by Hydra and run by its launchers."""
