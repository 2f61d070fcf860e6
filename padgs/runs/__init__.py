"""One run: its configuration, its folder, training, scoring, and going on after an interruption."""
