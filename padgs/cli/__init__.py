"""Entry points: the only place that knows Hydra, progress lines and the layout of run folders."""
